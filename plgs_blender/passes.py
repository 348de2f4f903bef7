"""A scene of its own in which the baked passes arrive as layers in the compositor.

One frame of its timeline is one view. The EXR files are read as an image sequence whose numbers have gaps: a
keyed offset leads from frame to file. Views whose names are not numbered cannot be a sequence; `show_view`
then swaps images.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from . import compat
from .colour import linear_rgba
from .owned import KEY, LIFT, OwnedDataBlocks, tag
from .pass_nodes import CLASSES, INSTANCES, PASSES, build, has_nodes, node_of, reading_nodes, use_image
from .results import LiftResult
from .sequence import NumberedNames, numbered


def place_passes(owned: OwnedDataBlocks, result: LiftResult) -> bpy.types.Scene | None:
    """Make or refill the scene "PLGS <name> passes"; None, and no scene, when the lift has no passes."""
    if not result.passes:
        owned.drop("scenes", "passes")
        return None
    name = f"PLGS {result.name} passes"
    scene = owned.block("scenes", "passes", lambda: _new_scene(name))
    scene.name = name
    sequence = numbered(list(result.passes))
    images = _images(owned, result.passes, sequence)
    tree = compat.compositor_tree(scene)
    if tree is None or not has_nodes(tree):
        tree = compat.new_compositor_tree(scene, name)
        build(tree, owned.lift, images[0])
        _first_mattes(tree, result)
    if not tree.is_embedded_data:
        tag(tree, owned.lift, "passes tree")
        owned.keep(tree)
    use_image(tree, images[0])
    if sequence is not None:
        images[0].source = "SEQUENCE"  # not before its layers were chosen: that only works on a single file
    _count_through(tree, len(result.passes), sequence)
    _fill_palette(owned, tree, "Instance", {each.id: each.colour for each in result.instances})
    _fill_palette(owned, tree, "Class", {each.id: each.colour for each in result.classes.categories})
    _set_timeline(scene, result)
    return scene


def show_view(scene: bpy.types.Scene, name: str) -> None:
    """Bring the passes of the view `name` up in a passes scene. KeyError when it has no such view."""
    frames = {marker.name: marker.frame for marker in scene.timeline_markers}
    scene.frame_set(frames[name])
    for image in bpy.data.images:
        if image.get(LIFT) == scene[LIFT] and image.get(KEY) == f"passes:{name}":
            use_image(compat.compositor_tree(scene), image)


def _new_scene(name: str) -> bpy.types.Scene:
    """Composites only: no camera, nothing rendered, colours as they are."""
    scene = bpy.data.scenes.new(name)
    scene.view_settings.view_transform = "Standard"
    scene.render.use_compositing, scene.render.use_sequencer = True, False
    scene.render.image_settings.file_format = "PNG"
    compat.composite_without_gpu(scene)
    return scene


def _images(
    owned: OwnedDataBlocks, files: Mapping[str, Path], sequence: NumberedNames | None
) -> list[bpy.types.Image]:
    """The EXR files as data-blocks: one that counts through all of them, or one each."""
    if sequence is not None:
        files = {"": files[sequence.first]}
    images = []
    for name, path in files.items():
        key = f"passes:{name}" if name else "passes"
        image = owned.block("images", key, partial(bpy.data.images.load, str(path), check_existing=False))
        image.source = "FILE"
        image.filepath = str(path)
        image.reload()
        # Blender learns what layers a file has by reading it, and must before a node can name one.
        _ = image.size[:]
        images.append(image)
    return images


def _count_through(tree: bpy.types.NodeTree, views: int, sequence: NumberedNames | None) -> None:
    """Timeline frame k shows file number sequence.numbers[k - 1]."""
    for node in reading_nodes(tree):
        node.frame_start, node.frame_duration = 1, views
        path = f'nodes["{bpy.utils.escape_identifier(node.name)}"].frame_offset'
        offsets = (
            [] if sequence is None else [number - k for k, number in enumerate(sequence.numbers, start=1)]
        )
        compat.constant_keys(tree, path, offsets)
    node_of(tree, PASSES).use_auto_refresh = True


def _fill_palette(
    owned: OwnedDataBlocks, tree: bpy.types.NodeTree, what: str, colours: Mapping[int, tuple[int, int, int]]
) -> None:
    """Write the colours, sRGB by id, into the palette image, linear, and scale ids to its width; id 0 is
    black.
    """
    width = max(colours, default=0) + 1
    image = owned.block(
        "images", f"{what} palette", lambda: _new_palette(f"PLGS {what.lower()} palette", width)
    )
    if image.size[0] != width:
        image.scale(width, 1)
    pixels: NDArray[np.float32] = np.zeros((width, 4), np.float32)
    pixels[:, 3] = 1.0
    for number, colour in colours.items():
        pixels[number] = linear_rgba(colour)
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.pack()  # it has no file: without this it would be lost on saving
    node_of(tree, f"{what} palette").image = image
    scale = node_of(tree, f"{what} scale")
    scale.inputs[1].default_value, scale.inputs[2].default_value = 1.0 / width, 0.5 / width


def _new_palette(name: str, width: int) -> bpy.types.Image:
    return bpy.data.images.new(name, width, 1, alpha=True, float_buffer=True, is_data=True)


def _first_mattes(tree: bpy.types.NodeTree, result: LiftResult) -> None:
    """Something to see in the matte nodes at first sight."""
    if result.instances:
        node_of(tree, INSTANCES).matte_id = result.instances[0].name
        node_of(tree, CLASSES).matte_id = result.instances[0].class_name


def _set_timeline(scene: bpy.types.Scene, result: LiftResult) -> None:
    """A frame and a marker for each view; the picture's size is the first view's."""
    scene.timeline_markers.clear()
    for frame, name in enumerate(result.passes, start=1):
        scene.timeline_markers.new(name, frame=frame)
    scene.frame_start, scene.frame_end = 1, len(result.passes)
    sizes = {frame.name: frame.size for frame in result.scene.frames}
    scene.render.resolution_x, scene.render.resolution_y = sizes[next(iter(result.passes))]
    scene.render.resolution_percentage = 100
