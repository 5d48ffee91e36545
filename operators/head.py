"""Operators for the head: add the mannequin, mark a scalp, place the head in the scan by hand or by landmarks."""

import bpy
from mathutils import Vector

from ..ct2hair_addon import scene
from ..ct2hair_addon.errors import CT2HairError
from ..ct2hair_addon.scene import ROLE, SCALP_GROUP
from .reporting import reported

GUIDE = "ct2hair_placed"
"""Custom property of the head that is placed by hand: the name of the scan's empty."""


class CT2HAIR_OT_add_head(bpy.types.Operator):
    """Add the built-in mannequin head at the 3D cursor, its scalp marked: to look at, to sculpt into your own"""

    bl_idname = "ct2hair.add_head"
    bl_label = "Mannequin Head"
    bl_options = {"REGISTER", "UNDO"}

    @reported(CT2HairError)
    def execute(self, context):
        ob = scene.add_template_head(context=context)
        for other in context.selected_objects:
            other.select_set(False)
        ob.select_set(True)
        context.view_layer.objects.active = ob
        self.report({"INFO"}, f"Added '{ob.name}'. Choose it as Head in the sidebar once you have shaped it")
        return {"FINISHED"}


class _OfMesh:
    @classmethod
    def poll(cls, context):
        if context.active_object is None or context.active_object.type != "MESH":
            cls.poll_message_set("Make the head's mesh the active object first")
            return False
        return True


class CT2HAIR_OT_scalp_from_selection(_OfMesh, bpy.types.Operator):
    """Make the selected vertices of the active mesh its scalp (vertex group 'scalp')"""

    bl_idname = "ct2hair.scalp_from_selection"
    bl_label = "Scalp from Selection"
    bl_options = {"REGISTER", "UNDO"}

    @reported(CT2HairError)
    def execute(self, context):
        count = scene.mark_scalp_by_selection(context.active_object)
        self.report({"INFO"}, f"{count} vertices are the scalp of '{context.active_object.name}': choose it as Head")
        return {"FINISHED"}


class CT2HAIR_OT_paint_scalp(_OfMesh, bpy.types.Operator):
    """Paint the scalp of the active mesh: weight over 0.5 is scalp. Ctrl Tab leaves the painting"""

    bl_idname = "ct2hair.paint_scalp"
    bl_label = "Paint Scalp"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        ob = context.active_object
        if ob.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        group = ob.vertex_groups.get(SCALP_GROUP) or ob.vertex_groups.new(name=SCALP_GROUP)
        ob.vertex_groups.active_index = group.index
        bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
        return {"FINISHED"}


class CT2HAIR_OT_place_head(bpy.types.Operator):
    """Put the head into the imported scan, for you to move, turn and scale to where the wearer's would be"""

    bl_idname = "ct2hair.place_head"
    bl_label = "Place by Hand"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if scan_empty() is None:
            cls.poll_message_set("There is no scan in the scene: import it first")
            return False
        return True

    @reported(CT2HairError)
    def execute(self, context):
        empty = scan_empty()
        chosen = context.scene.ct2hair.head
        ob = scene.add_template_head("Head to Place", context=context) if chosen is None else chosen
        volume = next((child for child in empty.children if child.type == "VOLUME"), None)
        if volume is not None:
            corners = [volume.matrix_world @ Vector(corner) for corner in volume.bound_box]
            middle = sum(corners, Vector()) / 8
            ob.location = middle - Vector((0.0, 0.0, 0.05))
        ob[GUIDE] = empty.name
        ob.display_type = "WIRE"
        for other in context.selected_objects:
            other.select_set(False)
        ob.select_set(True)
        context.view_layer.objects.active = ob
        self.report({"INFO"}, f"Move (G), turn (R) and scale (S) '{ob.name}' into the wig, then press Use This Place")
        return {"FINISHED"}


class _OfPlacedHead:
    @classmethod
    def poll(cls, context):
        ob = placed_head(context)
        if ob is None or bpy.data.objects.get(ob[GUIDE]) is None:
            cls.poll_message_set("Make the head that Place by Hand put into the scan the active object")
            return False
        return True


class CT2HAIR_OT_add_landmarks(_OfPlacedHead, bpy.types.Operator):
    """Add named balls on the placed head's scalp (hairline, crown, nape, sides): drag each to where it is in the wig"""

    bl_idname = "ct2hair.add_landmarks"
    bl_label = "Add Landmarks"
    bl_options = {"REGISTER", "UNDO"}

    @reported(CT2HairError)
    def execute(self, context):
        made = scene.add_landmarks(placed_head(context), context)
        for other in context.selected_objects:
            other.select_set(False)
        made[0].select_set(True)
        context.view_layer.objects.active = made[0]
        self.report(
            {"INFO"}, f"Drag the {len(made)} landmarks to their places in the wig (delete what you can't see), then fit"
        )
        return {"FINISHED"}


class CT2HAIR_OT_fit_landmarks(_OfPlacedHead, bpy.types.Operator):
    """Move, turn and scale the head so that its landmarks come to where you dragged them"""

    bl_idname = "ct2hair.fit_landmarks"
    bl_label = "Fit to Landmarks"
    bl_options = {"REGISTER", "UNDO"}

    @reported(CT2HairError)
    def execute(self, context):
        ob = placed_head(context)
        context.view_layer.update()
        left = scene.fit_to_landmarks(ob)
        for other in context.selected_objects:
            other.select_set(False)
        ob.select_set(True)
        context.view_layer.objects.active = ob
        self.report({"INFO"}, f"'{ob.name}' fits its landmarks to {left:.1f} mm. Press Use This Place when it looks right")
        return {"FINISHED"}


class CT2HAIR_OT_use_place(_OfPlacedHead, bpy.types.Operator):
    """Take the place of the active head for the reconstruction, which then only refines it"""

    bl_idname = "ct2hair.use_place"
    bl_label = "Use This Place"
    bl_options = {"REGISTER", "UNDO"}

    @reported(CT2HairError)
    def execute(self, context):
        ob = placed_head(context)
        context.view_layer.update()
        place = scene.placement(bpy.data.objects[ob[GUIDE]], ob)
        context.scene.ct2hair.settings.head.place = place
        for other in (ob, *scene.landmarks_of(ob)):
            other.hide_set(True)
        self.report({"INFO"}, "The head starts from this place. Clear 'Place' in the panel to find it automatically again")
        return {"FINISHED"}


class CT2HAIR_OT_forget_place(bpy.types.Operator):
    """Let the reconstruction find the head's place by itself again"""

    bl_idname = "ct2hair.forget_place"
    bl_label = "Find Automatically"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if not context.scene.ct2hair.settings.head.place:
            cls.poll_message_set("The head's place is found automatically already")
            return False
        return True

    def execute(self, context):
        context.scene.ct2hair.settings.head.place = ""
        return {"FINISHED"}


def placed_head(context):
    """The head that is placed by hand: the active object, or the head of the landmark that is; None where it is neither."""
    ob = context.active_object
    ob = ob.get(scene.LANDMARK_OF, ob) if ob is not None else None
    return ob if ob is not None and GUIDE in ob else None


def scan_empty():
    """The empty that carries the newest imported scan; None where there is none."""
    for collection in reversed(scene.results("scan")):
        for ob in collection.all_objects:
            if ob.get(ROLE) == "scan":
                return ob
    return None


def _menu(self, context):
    self.layout.operator(CT2HAIR_OT_add_head.bl_idname, icon="USER")
    self.layout.operator("ct2hair.import_scan", text="CT Scan of a Wig", icon="OUTLINER_OB_VOLUME")


CLASSES = (
    CT2HAIR_OT_add_head,
    CT2HAIR_OT_scalp_from_selection,
    CT2HAIR_OT_paint_scalp,
    CT2HAIR_OT_place_head,
    CT2HAIR_OT_add_landmarks,
    CT2HAIR_OT_fit_landmarks,
    CT2HAIR_OT_use_place,
    CT2HAIR_OT_forget_place,
)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.VIEW3D_MT_add.append(_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_add.remove(_menu)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
