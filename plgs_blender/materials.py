"""The colours and materials of a lift.

They are unlit: photos already contain their light.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import ArrayLike, NDArray

from .compat import use_nodes
from .owned import OwnedDataBlocks

CLASS_COLOURS, RELIEF, LIT, PICTURE = "Class colours", "Relief", "Lit", "Picture"
"""Labels of value nodes, 0..1. In the points' material: the class colour's share (the photo's has the rest), and the
strength of shading by the normal. In the meshes' material: how much the scene's lights replace the photos' own light,
and the share of their picture, else Col."""
CATCHER, LIGHT_FROM = "Shadow", "Light from"
"""Labels of the shadow catchers' nodes that depend on the lights."""
_GLOSS, _MIRRORED = 0.3, 0.04
"""Shadow catchers' roughness, and the fraction of light that they reflect in EEVEE."""
UNKNOWN = (96, 96, 96)
"""sRGB colour of points without a class."""
LIGHT = (0.35, -0.25, 0.9)
"""Direction towards the light that shades points, in world space."""
SHADE, SHADE_CONTRAST = 0.74, 0.3
"""Lightness of a point: SHADE + SHADE_CONTRAST * (LIGHT · normal)."""

DENSER = 4.0
"""Factor on the visibility of a splat. Blender draws half-transparent splats stochastically with few samples; nearly
opaque ones look smooth."""
_BYTES = np.arange(256) / 255.0
_LINEAR = np.where(_BYTES <= 0.04045, _BYTES / 12.92, ((_BYTES + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_rgba(srgb: ArrayLike) -> NDArray[np.float32]:
    """sRGB bytes 0..255 [..., 3] as linear colours with alpha 1, float32 [..., 4] (IEC 61966-2-1)."""
    value = np.asarray(srgb)
    rgba = np.ones((*value.shape[:-1], 4), np.float32)
    rgba[..., :3] = _LINEAR[value]
    return rgba


def object_colour(srgb: Sequence[int]) -> tuple[float, float, float, float]:
    """One sRGB colour as an object's viewport colour, linear RGBA."""
    red, green, blue, alpha = linear_rgba(srgb).tolist()
    return red, green, blue, alpha


def point_material(owned: OwnedDataBlocks) -> bpy.types.Material:
    """The points' material. It shows the attribute Col or, by CLASS_COLOURS, the object's colour. RELIEF shades it by
    the attribute normal."""
    material = owned.block("materials", "points", lambda: bpy.data.materials.new("PLGS points"))
    tree = use_nodes(material)
    if value_node(material, CLASS_COLOURS) is None:  # else the user may have set it, or built upon it
        _build_points(tree)
    return material


def clear_material(owned: OwnedDataBlocks) -> bpy.types.Material:
    """The invisible material of the boxes' faces."""
    material = owned.block("materials", "clear", lambda: bpy.data.materials.new("PLGS clear"))
    tree = use_nodes(material)
    if not any(node.bl_idname == "ShaderNodeBsdfTransparent" for node in tree.nodes):
        tree.nodes.clear()
        clear, end = _node(tree, "ShaderNodeBsdfTransparent", 0, 0), _node(tree, "ShaderNodeOutputMaterial", 1, 0)
        tree.links.new(clear.outputs[0], end.inputs["Surface"])
    material.surface_render_method = "DITHERED"  # needs no sorting
    return material


def surface_material(
    owned: OwnedDataBlocks, *, both_sides: bool = False, image: bpy.types.Image | None = None, of: str = ""
) -> bpy.types.Material:
    """The meshes' material, in the colours of the attribute Col or, with an ``image`` ``of`` one mesh, of that image.
    It is unlit, as photos contain their light; its value node LIT hands it over to the scene's lights. Backs are
    transparent, so that a room is open from outside, unless ``both_sides`` show."""
    name = "PLGS objects" if both_sides else "PLGS surfaces"
    key = f"objects {of}" if both_sides else f"surfaces {of}"
    material = owned.block("materials", key.strip(), lambda: bpy.data.materials.new(name))
    tree = use_nodes(material)
    if value_node(material, LIT) is None:
        _build_surface(tree, both_sides, image is not None)
    for node in _pictures(material):
        node.image = image
    material.use_backface_culling = not both_sides
    _cast_no_light(material)
    return material


def let_catch(ob: bpy.types.Object, catcher: bpy.types.Material | None) -> None:
    """Make an object's mesh catch shadows and reflections with this material, or, without one, be visible again. The
    photo has the room's own shadows, and light must come in through walls, so catchers cast none."""
    ob.is_shadow_catcher = catcher is not None
    ob.visible_shadow = catcher is None
    for slot in ob.material_slots:
        slot.link = "OBJECT"
        slot.material = catcher
        slot.link = "OBJECT" if catcher is not None else "DATA"


def image_of(material: bpy.types.Material) -> bpy.types.Image | None:
    """The image of a mesh's own material."""
    return next((node.image for node in _pictures(material)), None)


def _pictures(material: bpy.types.Material) -> list[Any]:
    return [node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeTexImage"]


def _build_surface(tree: bpy.types.NodeTree, both_sides: bool, has_image: bool) -> None:
    tree.nodes.clear()
    colour, lit = _node(tree, "ShaderNodeAttribute", 0, 0), _node(tree, "ShaderNodeValue", 1, 200)
    colour.attribute_name, lit.label, lit.outputs[0].default_value = "Col", LIT, 0.0
    light, matt = _node(tree, "ShaderNodeEmission", 1, 0), _node(tree, "ShaderNodeBsdfPrincipled", 1, -160)
    matt.inputs["Roughness"].default_value = 0.9
    seen = colour.outputs["Color"]
    if has_image:
        picture, share = _node(tree, "ShaderNodeTexImage", 0, -240), _node(tree, "ShaderNodeValue", 0, 200)
        share.label, share.outputs[0].default_value = "" if both_sides else PICTURE, 1.0
        seen = _mix(tree, 1, 300, "MIX", share.outputs[0], seen, picture.outputs["Color"])
    tree.links.new(seen, light.inputs["Color"])
    tree.links.new(seen, matt.inputs["Base Color"])
    shown = _mix_shaders(tree, 2, lit.outputs[0], light.outputs[0], matt.outputs[0])
    if not both_sides:
        back, clear = _node(tree, "ShaderNodeNewGeometry", 2, 300), _node(tree, "ShaderNodeBsdfTransparent", 2, -200)
        shown = _mix_shaders(tree, 3, back.outputs["Backfacing"], shown, clear.outputs[0])
    tree.links.new(shown, _node(tree, "ShaderNodeOutputMaterial", 4, 0).inputs["Surface"])


def _mix_shaders(tree: bpy.types.NodeTree, column: int, factor: Any, first: Any, second: Any) -> Any:
    mix = _node(tree, "ShaderNodeMixShader", column, 0)
    for source, target in zip((factor, first, second), mix.inputs, strict=True):
        tree.links.new(source, target)
    return mix.outputs[0]


def _cast_no_light(material: bpy.types.Material) -> None:
    """Stop Cycles from sampling surfaces as lights that only glow to be seen."""
    if hasattr(material, "cycles"):  # not in builds without Cycles
        material.cycles.emission_sampling = "NONE"


def catcher_material(owned: OwnedDataBlocks, scene: bpy.types.Scene) -> bpy.types.Material:
    """The material of shadow catchers, for the scene's current lights. Cycles takes its matt colours for bounced light
    and reflections. EEVEE has no catchers: there it is transparent, and black where less light arrives than without a
    shadow; its normal is the light's direction, so that walls facing away are not dark."""
    material = owned.block("materials", "catcher", lambda: bpy.data.materials.new("PLGS shadow catcher"))
    tree = use_nodes(material)
    if value_node(material, CATCHER) is None:
        tree.nodes.clear()
        colour, matt = _node(tree, "ShaderNodeAttribute", 0, 200), _node(tree, "ShaderNodeBsdfPrincipled", 1, 200)
        colour.attribute_name = "Col"
        white, lit, density = (
            _node(tree, f"ShaderNode{kind}", column, -200)
            for column, kind in enumerate(("BsdfDiffuse", "ShaderToRGB", "Math"))
        )
        density.operation, density.use_clamp, density.label = "MULTIPLY_ADD", True, CATCHER
        white.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
        facing = _node(tree, "ShaderNodeCombineXYZ", -1, -200)
        facing.label = LIGHT_FROM
        clear, black = _node(tree, "ShaderNodeBsdfTransparent", 3, -200), _node(tree, "ShaderNodeEmission", 3, -320)
        black.inputs["Strength"].default_value = 0.0
        gloss, both = _node(tree, "ShaderNodeBsdfAnisotropic", 3, -440), _node(tree, "ShaderNodeAddShader", 5, -200)
        gloss.inputs["Color"].default_value = (_MIRRORED, _MIRRORED, _MIRRORED, 1.0)
        for node in (matt, gloss):
            node.inputs["Roughness"].default_value = _GLOSS
        ends = [_node(tree, "ShaderNodeOutputMaterial", 6, row) for row in (200, -200)]
        ends[0].target, ends[1].target = "CYCLES", "EEVEE"
        back = _node(tree, "ShaderNodeNewGeometry", 2, 200)
        front = _mix_shaders(tree, 4, back.outputs["Backfacing"], matt.outputs[0], clear.outputs[0])
        shadow = _mix_shaders(tree, 4, density.outputs[0], clear.outputs[0], black.outputs[0])
        for source, target in (
            (colour.outputs["Color"], matt.inputs["Base Color"]),
            (facing.outputs[0], white.inputs["Normal"]),
            (white.outputs[0], lit.inputs[0]),
            (lit.outputs["Color"], density.inputs[0]),
            (shadow, both.inputs[0]),
            (gloss.outputs[0], both.inputs[1]),
            (front, ends[0].inputs["Surface"]),
            (both.outputs[0], ends[1].inputs["Surface"]),
        ):
            tree.links.new(source, target)
    direction, brightness = _light_of(scene)
    share, facing = value_node(material, CATCHER), value_node(material, LIGHT_FROM)
    assert share is not None and facing is not None
    for socket, value in zip(facing.inputs, direction, strict=True):
        socket.default_value = value
    share.inputs[1].default_value = -1.0 / brightness if brightness else 0.0
    share.inputs[2].default_value = 1.0 if brightness else 0.0
    material.use_backface_culling = material.use_backface_culling_shadow = True
    material.surface_render_method = "BLENDED"
    return material


def _light_of(scene: bpy.types.Scene) -> tuple[Vector, float]:
    """The direction from the origin to the scene's strongest light, and the brightness of a white surface facing it. (A
    sun of strength pi gives 1; a lamp's power spreads over a sphere, an area light's only forwards.)"""
    best, brightness = Vector((0.0, 0.0, 1.0)), 0.0
    for ob in scene.objects:
        if ob.type != "LIGHT" or ob.hide_render:
            continue
        lamp, away = ob.data, ob.matrix_world.translation
        strength = lamp.energy * max(lamp.color) * 2.0 ** getattr(lamp, "exposure", 0.0) / math.pi
        if lamp.type != "SUN":
            strength /= (math.pi if lamp.type == "AREA" else 4.0 * math.pi) * max(away.length_squared, 1e-6)
        if strength > brightness:
            back = ob.matrix_world.to_quaternion() @ Vector((0.0, 0.0, 1.0))
            best, brightness = back if lamp.type == "SUN" else away.normalized(), strength
    return best, brightness


def splat_material(owned: OwnedDataBlocks) -> bpy.types.Material:
    """The splats' material: unlit Col, fading from each square's middle by the attributes corner (in standard
    deviations) and opacity."""
    material = owned.block("materials", "splats", lambda: bpy.data.materials.new("PLGS splats"))
    tree = use_nodes(material)
    if not any(node.bl_idname == "ShaderNodeAttribute" for node in tree.nodes):
        tree.nodes.clear()
        colour, corner, opacity = (_node(tree, "ShaderNodeAttribute", 0, row) for row in (0, -200, -400))
        colour.attribute_name, corner.attribute_name, opacity.attribute_name = "Col", "corner", "opacity"
        square = _node(tree, "ShaderNodeVectorMath", 1, -200)
        square.operation = "DOT_PRODUCT"
        half, power, alpha = (_node(tree, "ShaderNodeMath", column, -200) for column in (2, 3, 4))
        half.operation, half.inputs[1].default_value = "MULTIPLY", -0.5
        power.operation, alpha.operation = "EXPONENT", "MULTIPLY"
        clear, light = _node(tree, "ShaderNodeBsdfTransparent", 6, 200), _node(tree, "ShaderNodeEmission", 6, 0)
        mix, end = _node(tree, "ShaderNodeMixShader", 7, 0), _node(tree, "ShaderNodeOutputMaterial", 8, 0)
        link = tree.links.new
        link(corner.outputs["Vector"], square.inputs[0])
        link(corner.outputs["Vector"], square.inputs[1])
        link(square.outputs["Value"], half.inputs[0])
        link(half.outputs[0], power.inputs[0])
        link(power.outputs[0], alpha.inputs[0])
        denser, front = (_node(tree, "ShaderNodeMath", column, -200) for column in (5, 6))
        denser.operation, denser.inputs[1].default_value, denser.use_clamp = "MULTIPLY", DENSER, True
        link(alpha.outputs[0], denser.inputs[0])
        geometry = _node(tree, "ShaderNodeNewGeometry", 0, 200)
        front.operation = "SUBTRACT"
        link(denser.outputs[0], front.inputs[0])
        link(geometry.outputs["Backfacing"], front.inputs[1])
        front.use_clamp = True
        link(opacity.outputs["Fac"], alpha.inputs[1])
        link(colour.outputs["Color"], light.inputs["Color"])
        for source, target in zip((front, clear, light), mix.inputs, strict=True):
            link(source.outputs[0], target)
        link(mix.outputs[0], end.inputs["Surface"])
    material.surface_render_method = "DITHERED"  # needs no sorting
    material.use_backface_culling = True
    _cast_no_light(material)
    return material


def value_node(material: bpy.types.Material, label: str) -> bpy.types.Node | None:
    """The node whose `.outputs[0].default_value` sets CLASS_COLOURS, RELIEF or LIT."""
    nodes = material.node_tree.nodes if material.node_tree else ()
    return next((node for node in nodes if node.label == label), None)


def _build_points(tree: bpy.types.NodeTree) -> None:
    tree.nodes.clear()
    photo, normal = _node(tree, "ShaderNodeAttribute", 0, 0), _node(tree, "ShaderNodeAttribute", 0, -400)
    photo.attribute_name, normal.attribute_name = "Col", "normal"
    own = _node(tree, "ShaderNodeObjectInfo", 0, -180)
    switch, relief = _node(tree, "ShaderNodeValue", 0, 140), _node(tree, "ShaderNodeValue", 2, 140)
    switch.label, relief.label = CLASS_COLOURS, RELIEF
    switch.outputs[0].default_value = relief.outputs[0].default_value = 0.0
    colour = _mix(tree, 1, 0, "MIX", switch.outputs[0], photo.outputs["Color"], own.outputs["Color"])
    facing = _node(tree, "ShaderNodeVectorMath", 1, -400)
    facing.operation, facing.inputs[1].default_value = "DOT_PRODUCT", LIGHT
    tree.links.new(normal.outputs["Vector"], facing.inputs[0])
    shade = _node(tree, "ShaderNodeMath", 2, -400)
    shade.operation = "MULTIPLY_ADD"
    shade.inputs[1].default_value, shade.inputs[2].default_value = SHADE_CONTRAST, SHADE
    tree.links.new(facing.outputs["Value"], shade.inputs[0])
    _emit(tree, _mix(tree, 3, 0, "MULTIPLY", relief.outputs[0], colour, shade.outputs[0]))


def _mix(tree: bpy.types.NodeTree, column: int, row: int, blend: str, factor: Any, first: Any, second: Any) -> Any:
    """Mix two colours and return the output socket."""
    node = _node(tree, "ShaderNodeMix", column, row)
    node.data_type, node.blend_type = "RGBA", blend
    for output, target in zip((factor, first, second), [s for s in node.inputs if s.enabled], strict=True):
        tree.links.new(output, target)
    return next(socket for socket in node.outputs if socket.enabled)


def _emit(tree: bpy.types.NodeTree, colour: Any) -> None:
    """Make the surface emit this colour. The new nodes stand to the right of all others."""
    column = max(node.location.x for node in tree.nodes) // 220 + 1
    light = _node(tree, "ShaderNodeEmission", column, 0)
    end = _node(tree, "ShaderNodeOutputMaterial", column + 1, 0)
    tree.links.new(colour, light.inputs["Color"])
    tree.links.new(light.outputs[0], end.inputs["Surface"])


def _node(tree: bpy.types.NodeTree, kind: str, column: float, row: float) -> bpy.types.Node:
    node = tree.nodes.new(kind)
    node.location = (220 * column, row)
    return node
