"""The materials of a result: hair by melanin, a mannequin's skin, and the scan's density as a cloud."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np

from .staging import NewData


@dataclass(frozen=True)
class HairColour:
    """Principled Hair in terms of pigment. melanin, redness: 0 to 1 (d'Eon et al. 2011); tint: linear RGB of a dye."""

    melanin: float
    redness: float
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    random: float = 0.25
    label: str = ""


HAIR_COLOURS: dict[str, HairColour] = {
    "black": HairColour(0.97, 0.25, label="Black"),
    "dark_brown": HairColour(0.86, 0.45, label="Dark brown"),
    "brown": HairColour(0.74, 0.55, label="Brown"),
    "auburn": HairColour(0.62, 0.95, label="Auburn"),
    "red": HairColour(0.45, 1.0, label="Red"),
    "dark_blond": HairColour(0.50, 0.55, label="Dark blond"),
    "blond": HairColour(0.30, 0.50, label="Blond"),
    "platinum": HairColour(0.10, 0.35, label="Platinum"),
    "grey": HairColour(0.32, 0.0, random=0.6, label="Grey"),
    "white": HairColour(0.03, 0.0, label="White"),
}
"""Hair colours by name, from measured amounts of eumelanin and pheomelanin put on Principled Hair's scale."""


HAIR_GROUP = "CT2Hair Strand"
"""Name of the node group that all hair materials share."""
HAIR_INPUTS = {
    "Melanin": 0.74,
    "Melanin Redness": 0.55,
    "Tint": (1.0, 1.0, 1.0, 1.0),
    "Roughness": 0.28,
    "Radial Roughness": 0.35,
    "Random Color": 0.25,
    "Random Roughness": 0.15,
}
"""Inputs of the group, each 0 to 1, and what they are for brown hair."""
SEEN = ((0.02, 0.012, 0.008), (0.77, 0.692, 0.408), (0.77, 0.392, 0.408))
"""Linear RGB of much hair together: without light through it, fair, and fair and red; by eye after Cycles' pictures."""
FACTOR, FIRST, SECOND, MIXED = 0, 6, 7, 2
"""Sockets of a Mix node for colours, which share their names with those for numbers."""


def hair_material(new: NewData, name: str, colour: str = "brown") -> bpy.types.Material:
    """Hair in one of `HAIR_COLOURS`, every strand a little different.

    Principled Hair in Cycles; in EEVEE, where light doesn't pass through strands, and in exports (USD's preview surface) a
    surface of the colour that much hair has together. Both follow the inputs of the node `Hair` (`HAIR_INPUTS`).
    """
    material = _material(new, name)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    strand = nodes.new("ShaderNodeGroup")
    strand.name = strand.label = "Hair"
    strand.node_tree = _hair_group(new)
    surface = nodes.new("ShaderNodeBsdfPrincipled")
    surface.name = "Surface"
    surface.inputs["Specular IOR Level"].default_value = 0.35
    traced, drawn = (nodes.new("ShaderNodeOutputMaterial") for _ in range(2))
    traced.target, drawn.target = "CYCLES", "EEVEE"
    links.new(strand.outputs["BSDF"], traced.inputs["Surface"])
    links.new(strand.outputs["Color"], surface.inputs["Base Color"])
    links.new(strand.outputs["Roughness"], surface.inputs["Roughness"])
    links.new(surface.outputs["BSDF"], drawn.inputs["Surface"])
    _place(nodes, [strand], [surface], [traced, drawn])
    set_hair_colour(material, colour)
    return material


def set_hair_colour(material: bpy.types.Material, colour: str) -> None:
    """Set a material of `hair_material` to one of `HAIR_COLOURS`. KeyError for an unknown name or another material."""
    wanted, nodes = HAIR_COLOURS[colour], material.node_tree.nodes
    pigment = {
        "Melanin": wanted.melanin,
        "Melanin Redness": wanted.redness,
        "Tint": (*wanted.tint, 1.0),
        "Random Color": wanted.random,
    }
    for name, value in {**HAIR_INPUTS, **pigment}.items():
        nodes["Hair"].inputs[name].default_value = value
    # what has no hair shader, the solid view and other programs, shows what the pigment looks like
    dark, fair, red = np.array(SEEN)
    light = (1.0 - wanted.melanin) ** 1.5
    seen = dark + light * (fair + wanted.redness * (red - fair) - dark)
    material.diffuse_color = (*seen, 1.0)
    if "Surface" in nodes:  # files of earlier versions have none
        nodes["Surface"].inputs["Base Color"].default_value = material.diffuse_color
        nodes["Surface"].inputs["Roughness"].default_value = 0.4


def _hair_group(new: NewData) -> bpy.types.NodeTree:
    """The group `HAIR_GROUP`: from pigment to Principled Hair, and to a colour and a roughness for who has no such shader."""
    known = bpy.data.node_groups.get(HAIR_GROUP)
    if known is not None and {item.name for item in known.interface.items_tree} >= {*HAIR_INPUTS, "BSDF", "Color"}:
        return known
    group = new.add(bpy.data.node_groups.new(HAIR_GROUP, "ShaderNodeTree"))
    for name, value in HAIR_INPUTS.items():
        kind = "NodeSocketFloat" if isinstance(value, float) else "NodeSocketColor"
        socket = group.interface.new_socket(name, in_out="INPUT", socket_type=kind)
        socket.default_value = value
        if isinstance(value, float):
            socket.subtype, socket.min_value, socket.max_value = "FACTOR", 0.0, 1.0
    for name, kind in (("BSDF", "NodeSocketShader"), ("Color", "NodeSocketColor"), ("Roughness", "NodeSocketFloat")):
        group.interface.new_socket(name, in_out="OUTPUT", socket_type=kind)
    nodes, links = group.nodes, group.links
    given, out = nodes.new("NodeGroupInput"), nodes.new("NodeGroupOutput")
    info = nodes.new("ShaderNodeHairInfo")
    shader = nodes.new("ShaderNodeBsdfHairPrincipled")
    shader.model, shader.parametrization = "CHIANG", "MELANIN"
    for name in HAIR_INPUTS:
        links.new(given.outputs[name], shader.inputs[name])
    links.new(info.outputs["Random"], shader.inputs["Random"])
    links.new(shader.outputs["BSDF"], out.inputs["BSDF"])

    def node(kind: str, **values) -> bpy.types.Node:
        made = nodes.new(kind)
        for name, value in values.items():
            setattr(made, name, value)
        return made

    fairness, light = node("ShaderNodeMath", operation="SUBTRACT", use_clamp=True), node("ShaderNodeMath", operation="POWER")
    fairness.inputs[0].default_value, light.inputs[1].default_value = 1.0, 1.5
    links.new(given.outputs["Melanin"], fairness.inputs[1])
    links.new(fairness.outputs[0], light.inputs[0])
    reds, fairs, dyed = (node("ShaderNodeMix", data_type="RGBA") for _ in range(3))
    dyed.blend_type = "MULTIPLY"
    dyed.inputs[FACTOR].default_value = 1.0
    for socket, value in zip((fairs.inputs[FIRST], reds.inputs[FIRST], reds.inputs[SECOND]), SEEN, strict=True):
        socket.default_value = (*value, 1.0)
    links.new(given.outputs["Melanin Redness"], reds.inputs[FACTOR])
    links.new(reds.outputs[MIXED], fairs.inputs[SECOND])
    links.new(light.outputs[0], fairs.inputs[FACTOR])
    links.new(fairs.outputs[MIXED], dyed.inputs[FIRST])
    links.new(given.outputs["Tint"], dyed.inputs[SECOND])
    spread, shade = node("ShaderNodeMath", operation="MULTIPLY_ADD"), node("ShaderNodeMath", operation="MULTIPLY_ADD")
    spread.inputs[1].default_value, spread.inputs[2].default_value = 2.0, -1.0
    shade.inputs[2].default_value = 1.0
    links.new(info.outputs["Random"], spread.inputs[0])
    links.new(spread.outputs[0], shade.inputs[0])
    links.new(given.outputs["Random Color"], shade.inputs[1])
    tone = nodes.new("ShaderNodeHueSaturation")
    links.new(dyed.outputs[MIXED], tone.inputs["Color"])
    links.new(shade.outputs[0], tone.inputs["Value"])
    links.new(tone.outputs["Color"], out.inputs["Color"])
    links.new(given.outputs["Roughness"], out.inputs["Roughness"])
    _place(nodes, [given, info], [fairness, spread, reds], [light, shade], [fairs], [dyed], [tone, shader], [out])
    return group


def support_material(new: NewData, name: str) -> bpy.types.Material:
    """Strands coloured by how much of each the scan backs: red 0, yellow 0.5, green 1 (attribute `support`)."""
    material = _material(new, name)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    out = nodes.new("ShaderNodeOutputMaterial")
    shader = nodes.new("ShaderNodeBsdfPrincipled")
    ramp = nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color = (0.8, 0.03, 0.02, 1.0)
    ramp.color_ramp.elements[1].color = (0.02, 0.55, 0.06, 1.0)
    ramp.color_ramp.elements.new(0.5).color = (0.85, 0.6, 0.02, 1.0)
    attribute = nodes.new("ShaderNodeAttribute")
    attribute.attribute_name = "support"
    links.new(attribute.outputs["Fac"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    links.new(shader.outputs["BSDF"], out.inputs["Surface"])
    _place(nodes, [attribute], [ramp], [shader], [out])
    return material


def orientation_material(new: NewData, name: str) -> bpy.types.Material:
    """Lines coloured by which way they run (attribute `direction`): red along x, green along y, blue along z."""
    material = _material(new, name)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    out = nodes.new("ShaderNodeOutputMaterial")
    glow = nodes.new("ShaderNodeEmission")  # as it is, in any light
    size = nodes.new("ShaderNodeVectorMath")
    size.operation = "ABSOLUTE"
    attribute = nodes.new("ShaderNodeAttribute")
    attribute.attribute_name = "direction"
    links.new(attribute.outputs["Vector"], size.inputs[0])
    links.new(size.outputs["Vector"], glow.inputs["Color"])
    links.new(glow.outputs["Emission"], out.inputs["Surface"])
    _place(nodes, [attribute], [size], [glow], [out])
    return material


def guide_material(new: NewData, name: str) -> bpy.types.Material:
    """A plain bright material that tells guides from hair."""
    material = _material(new, name)
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (0.02, 0.35, 0.75, 1.0)
    material.diffuse_color = (0.05, 0.45, 0.9, 1.0)
    return material


def skin_material(new: NewData, name: str) -> bpy.types.Material:
    """A shop mannequin's skin: matt plastic with a faint grain."""
    material = _material(new, name)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (0.52, 0.42, 0.35, 1.0)
    shader.inputs["Roughness"].default_value = 0.55
    grain = nodes.new("ShaderNodeTexNoise")
    grain.inputs["Scale"].default_value = 900.0
    bump = nodes.new("ShaderNodeBump")
    bump.inputs["Strength"].default_value = 0.08
    bump.inputs["Distance"].default_value = 0.0005
    links.new(grain.outputs["Fac"] if "Fac" in grain.outputs else grain.outputs[0], bump.inputs["Height"])
    links.new(bump.outputs["Normal"], shader.inputs["Normal"])
    _place(nodes, [grain], [bump], [shader], [nodes["Material Output"]])
    material.diffuse_color = (0.72, 0.58, 0.5, 1.0)
    return material


DENSITY_PRESETS: dict[str, tuple[tuple[float, tuple[float, float, float]], ...]] = {
    "hair": ((0.0, (0.55, 0.30, 0.14)), (0.5, (0.80, 0.52, 0.28)), (1.0, (1.0, 0.90, 0.70))),
    "x_ray": ((0.0, (0.15, 0.35, 0.55)), (0.5, (0.45, 0.70, 0.90)), (1.0, (1.0, 1.0, 1.0))),
    "heat": ((0.0, (0.15, 0.02, 0.60)), (0.5, (0.85, 0.08, 0.20)), (1.0, (1.0, 0.90, 0.20))),
}
"""Colours of the density between the hair level (0) and the densest of the wig (1), linear RGB."""

DENSITY_EXTINCTION = 500.0
"""Extinction of the densest voxels, 1/m: a wisp of one centimetre is then nearly opaque, a lone strand still seen."""
DENSITY_GLOW = 25.0
"""Light that the densest voxels send out themselves, 1/m: the inside of the wig stays readable in any lighting."""


def density_material(
    new: NewData, name: str, low: float, high: float, grid: str = "density", preset: str = "hair"
) -> bpy.types.Material:
    """The scan's density as a cloud: clear below `low` (the hair level), thickest and brightest from `high` on.

    low, high: grid values. grid: name of the OpenVDB grid. preset: one of `DENSITY_PRESETS`.
    """
    material = _material(new, name)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    out = nodes.new("ShaderNodeOutputMaterial")
    shader = nodes.new("ShaderNodeVolumePrincipled")
    shader.inputs["Density Attribute"].default_value = ""
    shader.inputs["Anisotropy"].default_value = 0.15
    attribute = nodes.new("ShaderNodeAttribute")
    attribute.attribute_name = grid
    window = nodes.new("ShaderNodeMapRange")
    window.name = "Window"
    window.clamp = True
    window.inputs["From Min"].default_value = low
    window.inputs["From Max"].default_value = max(high, low + 1e-6)
    ramp = nodes.new("ShaderNodeValToRGB")
    ramp.name = "Colours"
    extinction = nodes.new("ShaderNodeMath")
    extinction.name = "Extinction"
    extinction.operation = "MULTIPLY"
    extinction.inputs[1].default_value = DENSITY_EXTINCTION
    links.new(attribute.outputs["Fac"], window.inputs["Value"])
    links.new(window.outputs["Result"], ramp.inputs["Fac"])
    glow = nodes.new("ShaderNodeMath")
    glow.name = "Glow"
    glow.operation = "MULTIPLY"
    glow.inputs[1].default_value = DENSITY_GLOW
    for factor in (extinction, glow):
        links.new(window.outputs["Result"], factor.inputs[0])
    links.new(ramp.outputs["Color"], shader.inputs["Emission Color"])
    links.new(glow.outputs["Value"], shader.inputs["Emission Strength"])
    links.new(ramp.outputs["Color"], shader.inputs["Color"])
    links.new(extinction.outputs["Value"], shader.inputs["Density"])
    links.new(shader.outputs["Volume"], out.inputs["Volume"])
    _place(nodes, [attribute], [window], [ramp, extinction, glow], [shader], [out])
    set_density_colours(material, preset)
    return material


def set_density_colours(material: bpy.types.Material, preset: str) -> None:
    """Set the colours of a material of `density_material` to one of `DENSITY_PRESETS`."""
    elements = material.node_tree.nodes["Colours"].color_ramp.elements
    stops = DENSITY_PRESETS[preset]
    while len(elements) > 1:
        elements.remove(elements[-1])
    elements[0].position, elements[0].color = stops[0][0], (*stops[0][1], 1.0)
    for position, colour in stops[1:]:
        elements.new(position).color = (*colour, 1.0)


def _material(new: NewData, name: str) -> bpy.types.Material:
    material = new.add(bpy.data.materials.new(name))
    if material.node_tree is None:  # always there from 5.0 on, where use_nodes is deprecated
        material.use_nodes = True
    return material


def _place(nodes, *columns) -> None:
    """Lay nodes out in columns from left to right, so that the editor shows them readable."""
    for column, members in enumerate(columns):
        for row, node in enumerate(members):
            node.location = (300 * (column - len(columns)), -220 * row)
