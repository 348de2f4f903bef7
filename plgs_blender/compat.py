"""The differences between Blender 4.2 and 5.3, and nothing else, so that nothing else checks versions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

_COMPOSITOR_IS_A_GROUP = bpy.app.version >= (5, 0, 0)
BLEND_RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else set[str]()
"""Option of a property whose path may begin with "//"; earlier versions do not ask."""


def new_point_clouds(names: Sequence[str], xyz: Sequence[NDArray[np.float32]]) -> list[bpy.types.PointCloud]:
    """Make point clouds with these names and positions float32 [N, 3] in metres. Before 5.1 none can be resized."""
    if "resize" in bpy.types.PointCloud.bl_rna.functions:
        clouds = [bpy.data.pointclouds.new(name) for name in names]
        for cloud, own in zip(clouds, xyz, strict=True):
            cloud.resize(len(own))
    else:
        clouds = _clouds_by_nodes([len(own) for own in xyz])
    for cloud, name, own in zip(clouds, names, xyz, strict=True):
        cloud.name = name
        if len(own):
            cloud.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(own, np.float32).ravel())
    return clouds


def forget_selection(mesh: bpy.types.Mesh) -> None:
    """Delete a new mesh's record of what is selected in Edit Mode, which takes a byte per element."""
    for name in (".select_vert", ".select_edge", ".select_poly"):
        if name in mesh.attributes:
            mesh.attributes.remove(mesh.attributes[name])


def _clouds_by_nodes(counts: Sequence[int]) -> list[bpy.types.PointCloud]:
    """Make point clouds with ``counts`` points, from mesh vertices with geometry nodes, in a temporary scene."""
    scene, group = bpy.data.scenes.new("PLGS conversion"), new_geometry_group("PLGS conversion")
    objects: list[bpy.types.Object] = []
    try:
        kinds = ("NodeGroupInput", "GeometryNodeMeshToPoints", "NodeGroupOutput")
        start, convert, end = (group.nodes.new(kind) for kind in kinds)
        group.links.new(start.outputs[0], convert.inputs[0])
        group.links.new(convert.outputs[0], end.inputs[0])
        for count in counts:
            mesh = bpy.data.meshes.new("PLGS conversion")
            mesh.vertices.add(count)
            objects.append(bpy.data.objects.new("PLGS conversion", mesh))
            scene.collection.objects.link(objects[-1])
            objects[-1].modifiers.new("convert", "NODES").node_group = group
        layer = scene.view_layers[0]
        layer.update()
        instances = (one for one in layer.depsgraph.object_instances if one.object.type == "POINTCLOUD")
        found = {one.parent.original: one.object.data.copy() for one in instances}
        return [found.get(ob) or bpy.data.pointclouds.new("empty") for ob in objects]  # no points make no cloud
    finally:
        bpy.data.batch_remove([scene, group, *objects, *(ob.data for ob in objects)])  # each call checks all data


def new_geometry_group(name: str) -> bpy.types.NodeTree:
    """Make an empty geometry node group for a modifier, with one geometry input and one output."""
    group = bpy.data.node_groups.new(name, "GeometryNodeTree")
    group.is_modifier = True
    for direction in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    return group


def use_nodes(block: Any) -> bpy.types.NodeTree:
    """Return the shader nodes of a material or world. Before 5.0 they can be off, and are turned on."""
    if bpy.app.version < (5, 0, 0):
        block.use_nodes = True
    return block.node_tree


def compositor_tree(scene: bpy.types.Scene) -> bpy.types.NodeTree | None:
    """Return the scene's compositor nodes, None if it has none."""
    if _COMPOSITOR_IS_A_GROUP:
        return scene.compositing_node_group
    return scene.node_tree if scene.use_nodes else None


def new_compositor_tree(scene: bpy.types.Scene, name: str) -> bpy.types.NodeTree:
    """Make an empty compositor for the scene, with one image output."""
    if not _COMPOSITOR_IS_A_GROUP:
        scene.use_nodes = True
        scene.node_tree.nodes.clear()
        return scene.node_tree
    tree = bpy.data.node_groups.new(name, "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    scene.compositing_node_group = tree
    return tree


COMPOSITE_OUTPUT = "NodeGroupOutput" if _COMPOSITOR_IS_A_GROUP else "CompositorNodeComposite"
"""The node whose first input is the image that a render writes."""


def new_node(tree: bpy.types.NodeTree, *kinds: str) -> bpy.types.Node:
    """Add a node of the first of these kinds, newest first, that Blender has. Raises RuntimeError if it has none."""
    # Before 4.5 a compositor refuses the new kinds, and writes a line to the terminal for each that is tried.
    for kind in kinds if bpy.app.version >= (4, 5) else kinds[::-1]:
        try:
            return tree.nodes.new(kind)
        except RuntimeError:
            continue
    raise RuntimeError(f"this Blender ({bpy.app.version_string}) has none of the nodes {', '.join(kinds)}")


def new_colour_mix(tree: bpy.types.NodeTree) -> tuple[bpy.types.Node, Any, Any, Any, Any]:
    """Add a compositor node that mixes two colours. Returns the node and its sockets: factor, first, second, result."""
    node = new_node(tree, "ShaderNodeMix", "CompositorNodeMixRGB")
    if node.bl_idname == "ShaderNodeMix":
        node.data_type = "RGBA"
    factor, first, second = [socket for socket in node.inputs if socket.enabled]
    return node, factor, first, second, next(socket for socket in node.outputs if socket.enabled)


def _set_option(node: bpy.types.Node, socket: str, value: Any, name: str, earlier: Any) -> None:
    """Set a node's option that is a socket in newer versions and a property in older ones."""
    if socket in node.inputs:
        node.inputs[socket].default_value = value
    else:
        setattr(node, name, earlier)


def new_dilation(tree: bpy.types.NodeTree, pixels: int) -> bpy.types.Node:
    """Add a compositor node that grows a mask by whole pixels. Its input is Mask, its output number 0."""
    node = tree.nodes.new("CompositorNodeDilateErode")
    _set_option(node, "Size", pixels, "distance", pixels)
    if "Type" not in node.inputs:
        node.mode = "STEP"
    return node


def new_alpha_factor(tree: bpy.types.NodeTree) -> bpy.types.Node:
    """Add a compositor node that multiplies a picture, alpha included, by a mask. Inputs Image, Alpha; output 0."""
    node = tree.nodes.new("CompositorNodeSetAlpha")
    _set_option(node, "Type", "Apply Mask", "mode", "APPLY")
    return node


IN_A_PIXEL = 0.25
"""Where in a pixel `new_palette_lookup` must sample, in pixels from the lower left corner. The middle would do, but 4.3
takes the pixel whose corner is nearest."""


def new_palette_lookup(tree: bpy.types.NodeTree) -> bpy.types.Node:
    """Add a Map UV node that samples the nearest pixel without blending. Inputs Image, UV; output 0."""
    node = tree.nodes.new("CompositorNodeMapUV")
    _set_option(node, "Interpolation", "Nearest", "filter_type", "NEAREST")
    return node


def add_keys(
    block: bpy.types.ID,
    action: bpy.types.Action,
    path: str,
    *,
    frames: NDArray[np.floating],
    values: NDArray[np.floating],
    interpolation: str,
) -> None:
    """Key a property of ``block`` with values [N] or [N, K] at frames [N], replacing the action's earlier keys of it,
    and assign the action to the block. Actions have no slots before 4.4; from 5.0 on their curves belong to a slot."""
    animation = block.animation_data_create()
    if animation.action != action:
        animation.action = action
    for index, column in enumerate(np.atleast_2d(np.asarray(values, np.float64).T)):
        if "fcurve_ensure_for_datablock" in bpy.types.Action.bl_rna.functions:
            curve = action.fcurve_ensure_for_datablock(block, path, index=index)
        else:
            curve = action.fcurves.find(path, index=index) or action.fcurves.new(path, index=index)
        keys = curve.keyframe_points
        keys.clear()
        keys.add(len(frames))
        keys.foreach_set("co", np.stack([frames, column], axis=1).astype(np.float32).ravel())
        kinds = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items
        keys.foreach_set("interpolation", np.full(len(frames), kinds[interpolation].value, np.int32))
        curve.update()


STORED_COLOURS = ("Standard", "Un-tone-mapped")
"""View transforms that only encode colours for the display: Blender's own and that of ACES configurations."""


def show_stored_colours(scene: bpy.types.Scene) -> None:
    """Choose one of STORED_COLOURS if the OCIO configuration has one; otherwise its default stays."""
    for name in STORED_COLOURS:
        try:
            scene.view_settings.view_transform = name
        except TypeError:  # the configuration has no view transform of this name
            continue
        return


def composite_without_gpu(scene: bpy.types.Scene) -> None:
    """Composite on the CPU in full precision, so that ids stay whole numbers and no GPU is needed."""
    scene.render.compositor_device = "CPU"
    scene.render.compositor_precision = "FULL"


def to_overlay(srgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return sRGB pixels [H, W, 4] as a shader must write them over a 3D view, which before 5.0 encodes them itself."""
    if bpy.app.version >= (5, 0, 0):
        return srgb
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    linear[..., 3] = srgb[..., 3]
    return linear.astype(np.float32)
