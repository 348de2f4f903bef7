"""What the open Blender file holds and renders."""

from pathlib import Path
from typing import Any

import bpy
import numpy as np
import OpenEXR
from plgs.plgs_blender import compat
from plgs.plgs_blender.pass_nodes import output_of

DATA = ("objects", "collections", "cameras", "meshes", "pointclouds", "materials", "node_groups", "images", "scenes")


def counts() -> dict[str, int]:
    return {kind: len(names) for kind, names in contents().items()}


def contents() -> dict[str, Any]:
    """The names of all blocks, but of the picture that Blender 5.3 keeps for itself while the compositor runs."""
    return {
        kind: sorted(block.name for block in getattr(bpy.data, kind) if getattr(block, "source", "") != "VIEWER")
        for kind in DATA
    }


def look_through(scene: bpy.types.Scene, ob: bpy.types.Object) -> None:
    """Make a frame's camera the scene's, with its size and pixel aspect, so that renders match the photo pixel by
    pixel."""
    render = scene.render
    scene.camera = ob
    render.resolution_x, render.resolution_y, render.resolution_percentage = ob["width"], ob["height"], 100
    aspect = ob["fx"] / ob["fy"]
    render.pixel_aspect_x, render.pixel_aspect_y = (1.0, aspect) if aspect >= 1.0 else (1.0 / aspect, 1.0)


def values_of(data: Any, name: str, key: str = "value", width: int = 1) -> np.ndarray:
    """An attribute of points, [N] or [N, width]."""
    attribute = data.attributes[name]
    kind = {"INT": np.int32, "BOOLEAN": np.bool_}.get(attribute.data_type, np.float32)
    values = np.zeros(width * len(attribute.data), kind)
    attribute.data.foreach_get(key, values)
    return values.reshape(-1, width) if width > 1 else values


def rendered(scene: bpy.types.Scene, output: str, folder: Path, channels: str = "RGB") -> np.ndarray:
    """What a compositor's output gives at the current frame, float32 [H, W, C], written and read as EXR."""
    tree = compat.compositor_tree(scene)
    result = next(node for node in tree.nodes if node.bl_idname == compat.COMPOSITE_OUTPUT)
    tree.links.new(output_of(tree, output), result.inputs[0])
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", channels, "32"
    scene.render.filepath = str(folder / f"{output}.exr")
    with bpy.context.temp_override(scene=scene):
        bpy.ops.render.render(write_still=True)
    with OpenEXR.File(scene.render.filepath, separate_channels=True) as file:
        return np.stack([file.channels()[channel].pixels for channel in channels], axis=-1)
