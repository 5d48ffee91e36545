"""Operators on a result: what of it is shown, its measures by region, trimming and growing, colours of the cloud."""

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty

from ..ct2hair_addon import scene
from ..ct2hair_addon.errors import CT2HairError
from .output import OfResult
from .reporting import reported

REGION_ITEMS = [("all", "Whole scalp", "All hair")] + [
    (name, label, f"Hair rooted at the {label.lower()}") for name, label in scene.REGIONS.items()
]


WHAT = [
    ("hair", "Hair", "Show all strands, in the hair's material"),
    ("guides", "Guides", "Show the strands that were traced in the scan"),
    ("confidence", "Confidence", "Show all strands, red where the scan does not back them, green where it does"),
    ("scan", "Scan", "Show the scan's density as a cloud"),
]


class CT2HAIR_OT_show(OfResult, bpy.types.Operator):
    """Show this part of the result alone, the head with it"""

    bl_idname = "ct2hair.show"
    bl_label = "Show"
    bl_options = {"REGISTER", "UNDO"}

    what: EnumProperty(
        name="What",
        description="The part of the result that is shown",
        items=WHAT,
    )

    @classmethod
    def description(cls, context, properties):
        return {name: text for name, _, text in WHAT}[properties.what]

    @reported(CT2HairError)
    def execute(self, context):
        result = scene.active_result(context)
        wanted = {"hair": result.hair, "confidence": result.hair, "guides": result.guides, "scan": result.volume}[self.what]
        if wanted is None:
            self.report({"ERROR"}, f"The result has no {self.what}: load it from its job's folder again")
            return {"CANCELLED"}
        scene.show_confidence(result, self.what == "confidence")
        for ob in (result.hair, result.guides, result.volume):
            if ob is not None and ob.name in context.view_layer.objects:
                ob.hide_set(ob != wanted, view_layer=context.view_layer)
                ob.hide_viewport = False
        return {"FINISHED"}


class CT2HAIR_OT_measure(OfResult, bpy.types.Operator):
    """Measure strands, density and length of each region of the scalp"""

    bl_idname = "ct2hair.measure"
    bl_label = "Measure Regions"
    bl_options = {"REGISTER", "UNDO"}

    @reported(CT2HairError)
    def execute(self, context):
        measured = scene.measure_regions(scene.active_result(context))["all"]
        self.report({"INFO"}, f"{measured.strands} strands, {measured.density:.0f} a cm², {measured.length:.0f} mm long")
        return {"FINISHED"}


class CT2HAIR_OT_trim(OfResult, bpy.types.Operator):
    """Cut the hair of a region to a length from its roots"""

    bl_idname = "ct2hair.trim"
    bl_label = "Trim Hair"
    bl_options = {"REGISTER", "UNDO"}

    region: EnumProperty(name="Region", description="Part of the scalp whose hair is cut", items=REGION_ITEMS)
    length: FloatProperty(
        name="Length (mm)", description="Longer hair is cut to this. Unit: mm", default=150.0, min=1.0, max=3000.0
    )

    @reported(CT2HairError)
    def execute(self, context):
        count = scene.trim(scene.active_result(context), self.length, self.region)
        self.report({"INFO"}, f"{count} strands cut to {self.length:.0f} mm")
        return {"FINISHED"}


class CT2HAIR_OT_regrow(OfResult, bpy.types.Operator):
    """Grow the hair of a region anew from the guides, blended and not fitted to the scan; another seed, other strands"""

    bl_idname = "ct2hair.regrow"
    bl_label = "Regrow Hair"
    bl_options = {"REGISTER", "UNDO"}

    region: EnumProperty(name="Region", description="Part of the scalp whose hair grows anew", items=REGION_ITEMS)
    count: IntProperty(name="Strands", description="Strands to grow; 0 grows as many as there are", default=0, min=0)
    seed: IntProperty(name="Seed", description="Another seed grows other strands", default=1, min=0)

    @reported(CT2HairError)
    def execute(self, context):
        count = scene.regrow(scene.active_result(context), self.region, self.count, self.seed)
        self.report({"INFO"}, f"{count} strands grown anew")
        return {"FINISHED"}


class CT2HAIR_OT_full_width(OfResult, bpy.types.Operator):
    """Show the hair as wide as makes up for strands missing from a full head of hair (100,000), or true to life again"""

    bl_idname = "ct2hair.full_width"
    bl_label = "Fuller Hair"
    bl_options = {"REGISTER", "UNDO"}

    on: BoolProperty(name="Fuller", description="Off: widths true to life", default=True)

    def execute(self, context):
        hair = scene.active_result(context).hair
        factor = scene.full_width_factor(hair) if self.on else 1.0
        scene.set_width_factor(hair, factor)
        self.report({"INFO"}, f"Hair is shown {factor:.1f} times as wide as it is")
        return {"FINISHED"}


class CT2HAIR_OT_density_colours(bpy.types.Operator):
    """Give the scan's cloud the colours chosen in the panel"""

    bl_idname = "ct2hair.density_colours"
    bl_label = "Apply Density Colours"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if cloud_material(context) is None:
            cls.poll_message_set("There is no scan in the scene: import one first")
            return False
        return True

    def execute(self, context):
        material = cloud_material(context)
        if "Colours" not in material.node_tree.nodes:
            self.report({"ERROR"}, "The scan has another material than ours; set its colours in the shader editor")
            return {"CANCELLED"}
        scene.set_density_colours(material, context.scene.ct2hair.density)
        return {"FINISHED"}


def cloud_material(context):
    """The material of the active result's or the newest scan's cloud; None where there is none."""
    result = scene.active_result(context)
    volumes = [result.volume] if result is not None and result.volume is not None else []
    for collection in reversed(scene.results("scan")):
        volumes += [ob for ob in collection.all_objects if ob.type == "VOLUME"]
    for ob in volumes:
        if ob.active_material is not None and ob.active_material.node_tree is not None:
            return ob.active_material
    return None


CLASSES = (
    CT2HAIR_OT_show,
    CT2HAIR_OT_measure,
    CT2HAIR_OT_trim,
    CT2HAIR_OT_regrow,
    CT2HAIR_OT_full_width,
    CT2HAIR_OT_density_colours,
)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
