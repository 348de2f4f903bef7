"""The colours and materials of a lift. They are unlit, as photos already contain their light."""

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
"""Factor on the opacity of a splat: Blender draws half-transparent splats from few random samples."""
_BYTES = np.arange(256) / 255.0
_LINEAR = np.where(_BYTES <= 0.04045, _BYTES / 12.92, ((_BYTES + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_rgba(srgb: ArrayLike) -> NDArray[np.float32]:
    """Convert sRGB bytes 0..255 [..., 3] to linear colours with alpha 1, float32 [..., 4] (IEC 61966-2-1)."""
    value = np.asarray(srgb)
    rgba = np.ones((*value.shape[:-1], 4), np.float32)
    rgba[..., :3] = _LINEAR[value]
    return rgba


def object_colour(srgb: Sequence[int]) -> tuple[float, float, float, float]:
    """Convert one sRGB colour to an object's viewport colour, linear RGBA."""
    red, green, blue, alpha = linear_rgba(srgb).tolist()
    return red, green, blue, alpha


def point_material(owned: OwnedDataBlocks) -> bpy.types.Material:
    """The points' material: Col mixed with the object's colour by CLASS_COLOURS, and shaded by the normal by RELIEF."""
    material = owned.block("materials", "points", lambda: bpy.data.materials.new("PLGS points"))
    tree = use_nodes(material)
    if value_node(material, CLASS_COLOURS) is None:  # else the user may have set it, or built upon it
        _build_points(tree)
    return material


def clear_material(owned: OwnedDataBlocks) -> bpy.types.Material:
    """Return the invisible material of the boxes' faces."""
    material = owned.block("materials", "clear", lambda: bpy.data.materials.new("PLGS clear"))
    tree = use_nodes(material)
    if not any(node.bl_idname == "ShaderNodeBsdfTransparent" for node in tree.nodes):
        tree.nodes.clear()
        add_node(tree, "ShaderNodeOutputMaterial", 1, 0, add_node(tree, "ShaderNodeBsdfTransparent", 0, 0).outputs[0])
    material.surface_render_method = "DITHERED"  # needs no sorting
    return material


def surface_material(
    owned: OwnedDataBlocks, *, both_sides: bool = False, image: bpy.types.Image | None = None, of: str = ""
) -> bpy.types.Material:
    """Return the meshes' material, in the colours of the attribute Col. With ``image``, return one that shows this
    image, for the mesh ``of`` alone. It is unlit, as photos contain their light; its value node LIT lets the scene's
    lights act on it. Backs are transparent, so that a room is open from outside, unless ``both_sides`` show."""
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
        slot.material = catcher  # only of the object: its mesh keeps its own
        slot.link = "OBJECT" if catcher is not None else "DATA"


def image_of(material: bpy.types.Material) -> bpy.types.Image | None:
    """Return the image that a mesh's own material shows, None if it shows none."""
    return next((node.image for node in _pictures(material)), None)


def _pictures(material: bpy.types.Material) -> list[Any]:
    return [node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeTexImage"]


def _build_surface(tree: bpy.types.NodeTree, both_sides: bool, has_image: bool) -> None:
    tree.nodes.clear()
    seen = add_node(tree, "ShaderNodeAttribute", 0, 0, attribute_name="Col").outputs["Color"]
    lit = _add_value(tree, 1, 200, LIT, 0.0)
    if has_image:
        picture = add_node(tree, "ShaderNodeTexImage", 0, -240).outputs["Color"]
        share = _add_value(tree, 0, 200, "" if both_sides else PICTURE, 1.0)
        seen = _mix(tree, 1, 300, "MIX", share, seen, picture)
    light = add_node(tree, "ShaderNodeEmission", 1, 0, seen)
    matt = add_node(tree, "ShaderNodeBsdfPrincipled", 1, -160, seen)
    matt.inputs["Roughness"].default_value = 0.9
    shown = _mix_shaders(tree, 2, lit, light.outputs[0], matt.outputs[0])
    if not both_sides:
        back = add_node(tree, "ShaderNodeNewGeometry", 2, 300).outputs["Backfacing"]
        clear = add_node(tree, "ShaderNodeBsdfTransparent", 2, -200).outputs[0]
        shown = _mix_shaders(tree, 3, back, shown, clear)
    add_node(tree, "ShaderNodeOutputMaterial", 4, 0, shown)


def _mix_shaders(tree: bpy.types.NodeTree, column: int, factor: Any, first: Any, second: Any) -> Any:
    return add_node(tree, "ShaderNodeMixShader", column, 0, factor, first, second).outputs[0]


def _cast_no_light(material: bpy.types.Material) -> None:
    """Stop Cycles from sampling surfaces as lights that emit only to be visible."""
    if hasattr(material, "cycles"):  # not in builds without Cycles
        material.cycles.emission_sampling = "NONE"


def catcher_material(owned: OwnedDataBlocks, scene: bpy.types.Scene) -> bpy.types.Material:
    """Return the material of shadow catchers, for the scene's current lights. Cycles uses its matt colours for bounced
    light and reflections. EEVEE has no catchers: in EEVEE the material is transparent, and black where less light
    arrives than without a shadow; its normal is the light's direction, so that walls facing away are not dark."""
    material = owned.block("materials", "catcher", lambda: bpy.data.materials.new("PLGS shadow catcher"))
    tree = use_nodes(material)
    if value_node(material, CATCHER) is None:
        tree.nodes.clear()
        colour = add_node(tree, "ShaderNodeAttribute", 0, 200, attribute_name="Col").outputs["Color"]
        matt = add_node(tree, "ShaderNodeBsdfPrincipled", 1, 200, colour)
        facing = add_node(tree, "ShaderNodeCombineXYZ", -1, -200, label=LIGHT_FROM)
        white = add_node(tree, "ShaderNodeBsdfDiffuse", 0, -200, (1.0, 1.0, 1.0, 1.0), None, facing.outputs[0])
        lit = add_node(tree, "ShaderNodeShaderToRGB", 1, -200, white.outputs[0]).outputs["Color"]
        settings = {"operation": "MULTIPLY_ADD", "use_clamp": True, "label": CATCHER}
        density = add_node(tree, "ShaderNodeMath", 2, -200, lit, **settings).outputs[0]
        clear = add_node(tree, "ShaderNodeBsdfTransparent", 3, -200).outputs[0]
        black = add_node(tree, "ShaderNodeEmission", 3, -320, None, 0.0).outputs[0]
        gloss = add_node(tree, "ShaderNodeBsdfAnisotropic", 3, -440, (_MIRRORED, _MIRRORED, _MIRRORED, 1.0))
        for node in (matt, gloss):
            node.inputs["Roughness"].default_value = _GLOSS
        back = add_node(tree, "ShaderNodeNewGeometry", 2, 200).outputs["Backfacing"]
        front = _mix_shaders(tree, 4, back, matt.outputs[0], clear)
        shadow = _mix_shaders(tree, 4, density, clear, black)
        both = add_node(tree, "ShaderNodeAddShader", 5, -200, shadow, gloss.outputs[0]).outputs[0]
        add_node(tree, "ShaderNodeOutputMaterial", 6, 200, front, target="CYCLES")
        add_node(tree, "ShaderNodeOutputMaterial", 6, -200, both, target="EEVEE")
    direction, brightness = _light_of(scene)
    share, facing = value_node(material, CATCHER), value_node(material, LIGHT_FROM)
    assert share is not None and facing is not None
    for socket, value in zip(facing.inputs, direction, strict=True):
        socket.default_value = value
    share.inputs[1].default_value = -1.0 / brightness if brightness else 0.0  # 1 - lit / brightness
    share.inputs[2].default_value = 1.0 if brightness else 0.0
    material.use_backface_culling = material.use_backface_culling_shadow = True
    material.surface_render_method = "BLENDED"
    return material


def _light_of(scene: bpy.types.Scene) -> tuple[Vector, float]:
    """Return the direction from the origin to the scene's strongest light, and the brightness of a white surface facing
    it. (A sun of strength pi gives 1; a lamp's power spreads over a sphere, an area light's over a hemisphere.)"""
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
    """The squares' material: unlit Col, fading from each square's middle by the attributes corner and opacity."""
    material = owned.block("materials", "splats", lambda: bpy.data.materials.new("PLGS splats"))
    tree = use_nodes(material)
    if not any(node.bl_idname == "ShaderNodeAttribute" for node in tree.nodes):
        tree.nodes.clear()
        colour, corner, opacity = (
            add_node(tree, "ShaderNodeAttribute", 0, row, attribute_name=name).outputs
            for row, name in ((0, "Col"), (-200, "corner"), (-400, "opacity"))
        )
        along = corner["Vector"]
        square = add_node(tree, "ShaderNodeVectorMath", 1, -200, along, along, operation="DOT_PRODUCT").outputs["Value"]
        fading = _maths(tree, 3, "EXPONENT", _maths(tree, 2, "MULTIPLY", square, -0.5))
        alpha = _maths(tree, 4, "MULTIPLY", fading, opacity["Fac"])
        denser = _maths(tree, 5, "MULTIPLY", alpha, DENSER, use_clamp=True)
        back = add_node(tree, "ShaderNodeNewGeometry", 0, 200).outputs["Backfacing"]
        front = _maths(tree, 6, "SUBTRACT", denser, back, use_clamp=True)
        clear = add_node(tree, "ShaderNodeBsdfTransparent", 6, 200).outputs[0]
        light = add_node(tree, "ShaderNodeEmission", 6, 0, colour["Color"]).outputs[0]
        add_node(tree, "ShaderNodeOutputMaterial", 8, 0, _mix_shaders(tree, 7, front, clear, light))
    material.surface_render_method = "DITHERED"  # needs no sorting
    material.use_backface_culling = True
    _cast_no_light(material)
    return material


def value_node(material: bpy.types.Material, label: str) -> bpy.types.Node | None:
    """Return the node whose first output's default sets ``label``: CLASS_COLOURS, RELIEF or LIT; None without it."""
    nodes = material.node_tree.nodes if material.node_tree else ()
    return next((node for node in nodes if node.label == label), None)


def _build_points(tree: bpy.types.NodeTree) -> None:
    tree.nodes.clear()
    photo = add_node(tree, "ShaderNodeAttribute", 0, 0, attribute_name="Col").outputs["Color"]
    normal = add_node(tree, "ShaderNodeAttribute", 0, -400, attribute_name="normal").outputs["Vector"]
    own = add_node(tree, "ShaderNodeObjectInfo", 0, -180).outputs["Color"]
    colour = _mix(tree, 1, 0, "MIX", _add_value(tree, 0, 140, CLASS_COLOURS, 0.0), photo, own)
    facing = add_node(tree, "ShaderNodeVectorMath", 1, -400, normal, LIGHT, operation="DOT_PRODUCT").outputs["Value"]
    shade = add_node(tree, "ShaderNodeMath", 2, -400, facing, SHADE_CONTRAST, SHADE, operation="MULTIPLY_ADD")
    shown = _mix(tree, 3, 0, "MULTIPLY", _add_value(tree, 2, 140, RELIEF, 0.0), colour, shade.outputs[0])
    light = add_node(tree, "ShaderNodeEmission", 4, 0, shown)
    add_node(tree, "ShaderNodeOutputMaterial", 5, 0, light.outputs[0])


def _mix(tree: bpy.types.NodeTree, column: int, row: int, blend: str, *colours: Any) -> Any:
    """Add a node that mixes two colours by a factor (``colours``: factor, then both), and return its output socket."""
    node = add_node(tree, "ShaderNodeMix", column, row, *colours, data_type="RGBA", blend_type=blend)
    return next(socket for socket in node.outputs if socket.enabled)  # it has one for each type of data


def _maths(tree: bpy.types.NodeTree, column: int, operation: str, *inputs: Any, use_clamp: bool = False) -> Any:
    node = add_node(tree, "ShaderNodeMath", column, -200, *inputs, operation=operation, use_clamp=use_clamp)
    return node.outputs[0]


def _add_value(tree: bpy.types.NodeTree, column: int, row: int, label: str, value: float) -> Any:
    socket = add_node(tree, "ShaderNodeValue", column, row, label=label).outputs[0]
    socket.default_value = value
    return socket


def add_node(
    tree: bpy.types.NodeTree, kind: str, column: float, row: float, *inputs: Any, **settings: Any
) -> bpy.types.Node:
    """Add a node with these settings. ``inputs`` are, in order, sockets to link or values; None leaves one as it is."""
    node = tree.nodes.new(kind)
    node.location = (220 * column, row)
    for name, value in settings.items():  # first, because they decide which inputs there are
        setattr(node, name, value)
    for given, socket in zip(inputs, [each for each in node.inputs if each.enabled], strict=False):
        if isinstance(given, bpy.types.NodeSocket):
            tree.links.new(given, socket)
        elif given is not None:
            socket.default_value = given
    return node
