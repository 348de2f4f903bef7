"""What differs between Blender 4.2 and 5.2, and nothing else: the rest of the extension reads one way."""

from __future__ import annotations

from typing import Any

import bpy
import gpu
import numpy as np
from numpy.typing import NDArray

_COMPOSITOR_IS_A_GROUP = bpy.app.version >= (5, 0, 0)


def new_point_cloud(name: str, xyz: NDArray[np.float32]) -> bpy.types.PointCloud:
    """A point cloud data-block with positions float32 [N, 3] in metres. Before 5.1 a cloud cannot be
    resized.
    """
    if "resize" in bpy.types.PointCloud.bl_rna.functions:
        cloud = bpy.data.pointclouds.new(name)
        cloud.resize(len(xyz))
    else:
        cloud = _cloud_by_nodes(len(xyz))
        cloud.name = name
    if len(xyz):
        cloud.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(xyz, np.float32).ravel())
    return cloud


def _cloud_by_nodes(count: int) -> bpy.types.PointCloud:
    """Let geometry nodes turn a mesh's vertices into points, in a scene of its own, and keep a copy of the
    result.
    """
    if not count:
        return bpy.data.pointclouds.new("empty")
    scene = bpy.data.scenes.new("PLGS conversion")
    mesh = bpy.data.meshes.new("PLGS conversion")
    mesh.vertices.add(count)
    ob = bpy.data.objects.new("PLGS conversion", mesh)
    scene.collection.objects.link(ob)
    group = bpy.data.node_groups.new("PLGS conversion", "GeometryNodeTree")
    try:
        for direction in ("INPUT", "OUTPUT"):
            group.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
        start, convert, end = (
            group.nodes.new(kind)
            for kind in ("NodeGroupInput", "GeometryNodeMeshToPoints", "NodeGroupOutput")
        )
        group.links.new(start.outputs[0], convert.inputs[0])
        group.links.new(convert.outputs[0], end.inputs[0])
        ob.modifiers.new("convert", "NODES").node_group = group
        layer = scene.view_layers[0]
        layer.update()
        instances = layer.depsgraph.object_instances
        return next(each.object.data.copy() for each in instances if each.object.type == "POINTCLOUD")
    finally:
        bpy.data.objects.remove(ob)
        bpy.data.meshes.remove(mesh)
        bpy.data.node_groups.remove(group)
        bpy.data.scenes.remove(scene)


def use_nodes(block: Any) -> bpy.types.NodeTree:
    """The shader nodes of a material or world, which always has them from 5.0 on."""
    if bpy.app.version < (5, 0, 0):
        block.use_nodes = True
    return block.node_tree


def compositor_tree(scene: bpy.types.Scene) -> bpy.types.NodeTree | None:
    """The scene's compositor nodes, None when it has none."""
    if _COMPOSITOR_IS_A_GROUP:
        return scene.compositing_node_group
    return scene.node_tree if scene.use_nodes else None


def new_compositor_tree(scene: bpy.types.Scene, name: str) -> bpy.types.NodeTree:
    """An empty compositor for the scene, with one image as its result."""
    if not _COMPOSITOR_IS_A_GROUP:
        scene.use_nodes = True
        scene.node_tree.nodes.clear()
        return scene.node_tree
    tree = bpy.data.node_groups.new(name, "CompositorNodeTree")
    tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    scene.compositing_node_group = tree
    return tree


COMPOSITE_OUTPUT = "NodeGroupOutput" if _COMPOSITOR_IS_A_GROUP else "CompositorNodeComposite"
"""The node whose first input is what a render writes."""


def new_node(tree: bpy.types.NodeTree, *kinds: str) -> bpy.types.Node:
    """A node of the first kind that this Blender knows; RuntimeError when it knows none."""
    for kind in kinds:
        try:
            return tree.nodes.new(kind)
        except RuntimeError:
            continue
    raise RuntimeError(f"this Blender ({bpy.app.version_string}) has none of the nodes {', '.join(kinds)}")


def new_colour_mix(tree: bpy.types.NodeTree) -> tuple[bpy.types.Node, Any, Any, Any, Any]:
    """A compositor node that mixes two colours, and its sockets: (node, factor, first, second, result)."""
    node = new_node(tree, "ShaderNodeMix", "CompositorNodeMixRGB")
    if node.bl_idname == "ShaderNodeMix":
        node.data_type = "RGBA"
    factor, first, second = [socket for socket in node.inputs if socket.enabled]
    return node, factor, first, second, next(socket for socket in node.outputs if socket.enabled)


def new_dilation(tree: bpy.types.NodeTree, pixels: int) -> bpy.types.Node:
    """A compositor node that makes a mask grow by whole pixels. Input Mask; output 0."""
    node = tree.nodes.new("CompositorNodeDilateErode")
    if "Size" in node.inputs:
        node.inputs["Size"].default_value = pixels
    else:
        node.distance = pixels
    if "Type" not in node.inputs:
        node.mode = "STEP"
    return node


def new_alpha_factor(tree: bpy.types.NodeTree) -> bpy.types.Node:
    """A compositor node that multiplies a picture, its alpha too, by a mask. Inputs Image, Alpha; output 0."""
    node = tree.nodes.new("CompositorNodeSetAlpha")
    if "Type" in node.inputs:
        node.inputs["Type"].default_value = "Apply Mask"
    else:
        node.mode = "APPLY"
    return node


def new_compositor_group(name: str) -> bpy.types.NodeTree:
    """An empty group of compositor nodes."""
    return bpy.data.node_groups.new(name, "CompositorNodeTree")


IN_A_PIXEL = 0.25
"""Where in a pixel `new_palette_lookup` is to look, in pixels from its lower left corner. The middle would do, but 4.3
takes the pixel whose corner is nearest."""


def new_palette_lookup(tree: bpy.types.NodeTree) -> bpy.types.Node:
    """A Map UV node that takes the nearest pixel and blends nothing. Inputs Image, UV; output 0."""
    node = tree.nodes.new("CompositorNodeMapUV")
    if "Interpolation" in node.inputs:
        node.inputs["Interpolation"].default_value = "Nearest"
    else:
        node.filter_type = "NEAREST"
    return node


def constant_keys(tree: bpy.types.NodeTree, path: str, values: list[int]) -> None:
    """Give a property of the tree one value a frame, from frame 1, without interpolation; earlier keys go."""
    for curve in _curves(tree):
        if curve.data_path == path:
            curve.keyframe_points.clear()
    for frame, value in enumerate(values, start=1):
        owner, _, name = path.rpartition(".")
        setattr(tree.path_resolve(owner), name, value)
        tree.keyframe_insert(path, frame=frame)
    for curve in _curves(tree):
        if curve.data_path == path:
            for key in curve.keyframe_points:
                key.interpolation = "CONSTANT"


def add_keys(
    block: bpy.types.ID,
    action: bpy.types.Action,
    path: str,
    frames: NDArray[np.floating],
    values: NDArray[np.floating],
    interpolation: str,
) -> None:
    """Key a property of ``block`` in an action that is empty of it: float values [N] or [N, K] at frames [N].

    The action becomes the block's. Before 4.4 an action has no slots, from 5.0 on its curves belong to one.
    """
    animation = block.animation_data_create()
    if animation.action != action:
        animation.action = action
    columns = np.asarray(values, np.float64).reshape(len(frames), -1).T
    for index, column in enumerate(columns):
        if "fcurve_ensure_for_datablock" in bpy.types.Action.bl_rna.functions:
            curve = action.fcurve_ensure_for_datablock(block, path, index=index)
        else:
            curve = action.fcurves.new(path, index=index)
        keys = curve.keyframe_points
        keys.add(len(frames))
        keys.foreach_set("co", np.stack([frames, column], axis=1).astype(np.float32).ravel())
        kinds = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items
        keys.foreach_set("interpolation", np.full(len(frames), kinds[interpolation].value, np.int32))
        curve.update()


def _curves(block: Any) -> list[Any]:
    """Every animation curve of a data-block."""
    action = block.animation_data and block.animation_data.action
    if action is None:
        return []
    if hasattr(action, "layers"):
        slot = block.animation_data.action_slot
        bags = [strip.channelbag(slot) for layer in action.layers for strip in layer.strips]
        return [curve for bag in bags if bag is not None for curve in bag.fcurves]
    return list(action.fcurves)


def composite_without_gpu(scene: bpy.types.Scene) -> None:
    """Composite on the processor in full precision, so that ids stay whole and machines without a GPU can do
    it.
    """
    scene.render.compositor_device = "CPU"
    scene.render.compositor_precision = "FULL"


def find_layers_again(image: bpy.types.Image) -> None:
    """Let an image sequence find its layers after its path was changed.

    Blender 4.5 otherwise forgets that the files are multilayer: the sockets of the Image nodes vanish, and with
    them all links, and the compositor shows grey.
    """
    if image.source == "SEQUENCE":
        image.source = "FILE"
        image.size[:]  # asking is what loads the file
        image.source = "SEQUENCE"


def point_shader() -> Any:
    """The shader that draws points ("pos") with a colour each ("color"). Before 4.5 the one for all shapes did it."""
    try:
        return gpu.shader.from_builtin("POINT_FLAT_COLOR")
    except ValueError:
        return gpu.shader.from_builtin("FLAT_COLOR")


def to_overlay(srgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pixels [H, W, 4] as a shader must write them over a 3D view, which before 5.0 turns them to sRGB itself."""
    if bpy.app.version >= (5, 0, 0):
        return srgb
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    linear[..., 3] = srgb[..., 3]
    return linear.astype(np.float32)
