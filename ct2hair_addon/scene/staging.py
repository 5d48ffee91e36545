"""New data for the scene, all or nothing: what a failed operation made is removed again, and links come last."""

from __future__ import annotations

import bpy


class NewData:
    """The data-blocks made inside a `with` block; removed again where the block raises.

    Objects are not linked to the scene before the block is through, so that a failure leaves the scene as it was::

        with NewData() as new:
            mesh = new.add(bpy.data.meshes.new("Head"))
            ...
        scene.collection.children.link(collection)
    """

    def __init__(self) -> None:
        self._made: list[bpy.types.ID] = []

    def __enter__(self) -> NewData:
        return self

    def __exit__(self, kind, value, traceback) -> None:
        if kind is not None:
            self.remove()

    def add(self, block):
        """Remember a new data-block, and return it."""
        self._made.append(block)
        return block

    def remove(self) -> None:
        """Remove everything that was made."""
        alive = []
        for block in self._made:
            try:
                block.name  # noqa: B018  a removed data-block raises here
            except ReferenceError:
                continue
            alive.append(block)
        bpy.data.batch_remove(alive)
        self._made.clear()


def remove_collection(collection: bpy.types.Collection) -> None:
    """Remove a collection, its objects, and their data, materials and node groups where nobody else uses them."""
    objects = list(collection.all_objects)
    collections = [collection, *collection.children_recursive]
    data = {ob.data for ob in objects if ob.data is not None}
    materials = {slot.material for ob in objects for slot in ob.material_slots if slot.material is not None}
    bpy.data.batch_remove([*objects, *collections])
    bpy.data.batch_remove([block for block in data if not block.users])
    bpy.data.batch_remove([material for material in materials if not material.users])
