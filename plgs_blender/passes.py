"""Scenes of their own in which the baked passes arrive as layers in the compositor: one for the lift's frames, and one
for each camera that more was baked from.

One frame of the first one's timeline is one view. The EXR files are read as an image sequence whose numbers have gaps:
a keyed offset leads from frame to file. Views whose names are not numbered cannot be a sequence; `show_view` then swaps
images.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.scene.matte_names import matte_names
from . import compat
from .colour import linear_rgba
from .exr_header import size_of
from .owned import KEY, LIFT, OwnedDataBlocks, key_of, tag
from .pass_nodes import CLASSES, INSTANCES, PASSES, build, has_nodes, node_of, reading_nodes, use_image
from .results import LiftResult
from .sequence import NumberedNames, numbered, sequences

SHOT = "shot:"
"""Begins the key of a scene whose passes were baked from a camera of the user's."""


def place_passes(owned: OwnedDataBlocks, result: LiftResult) -> bpy.types.Scene | None:
    """Make or refill the scene "PLGS <name> passes"; None, and no scene, when no frame of the lift has passes."""
    if not result.passes:
        owned.drop("scenes", PASSES)
        return None
    sequence = numbered(list(result.passes))
    scene, tree = _fill_scene(owned, result, PASSES, result.passes, sequence)
    offsets = [] if sequence is None else [number - k for k, number in enumerate(sequence.numbers, start=1)]
    _count_through(tree, len(result.passes), offsets, scene.frame_current)
    _set_timeline(scene, result)
    return scene


def place_shots(owned: OwnedDataBlocks, result: LiftResult, shot_scene: bpy.types.Scene) -> list[bpy.types.Scene]:
    """Make or refill a scene "PLGS <name> <camera>" for each camera that more was baked from. Its frames are those of
    `shot_scene`, in which the camera moves: whose rate and pixel aspect it takes."""
    groups = sequences(list(result.shots))
    for scene in list(bpy.data.scenes):
        key = key_of(scene, owned.lift) or ""
        if key.startswith(SHOT) and key.removeprefix(SHOT) not in groups:
            owned.drop("scenes", key)
    scenes = []
    for camera, names in groups.items():
        files = {name: result.shots[name] for name in names}
        sequence = numbered(names)
        scene, tree = _fill_scene(owned, result, f"{SHOT}{camera}", files, sequence)
        numbers = (1,) if sequence is None else sequence.numbers
        _count_on(tree, min(numbers), max(numbers))
        _take_after(scene, shot_scene, numbers, size_of(files[names[0]]))
        scenes.append(scene)
    return scenes


def _fill_scene(
    owned: OwnedDataBlocks, result: LiftResult, key: str, files: Mapping[str, Path], sequence: NumberedNames | None
) -> tuple[bpy.types.Scene, bpy.types.NodeTree]:
    """A scene for these files, and its nodes; made where it is missing."""
    name = f"PLGS {result.name} {key.removeprefix(SHOT)}"
    scene = owned.block("scenes", key, lambda: _new_scene(name))
    scene.name = name
    images = _images(owned, key, files, sequence)
    tree = compat.compositor_tree(scene)
    if tree is None or not has_nodes(tree):
        tree = compat.new_compositor_tree(scene, name)
        build(tree, owned.lift, images[0])
        _first_mattes(tree, result)
    if not tree.is_embedded_data:
        tag(tree, owned.lift, f"{key} tree")
        owned.keep(tree)
    use_image(tree, images[0])
    if sequence is not None:
        images[0].source = "SEQUENCE"  # not before its layers were chosen: that only works on a single file
    _fill_palette(owned, tree, "Instance", {each.id: each.colour for each in result.instances})
    _fill_palette(owned, tree, "Class", {each.id: each.colour for each in result.classes.categories})
    return scene, tree


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
    owned: OwnedDataBlocks, key: str, files: Mapping[str, Path], sequence: NumberedNames | None
) -> list[bpy.types.Image]:
    """The EXR files as data-blocks: one that counts through all of them, or one each."""
    if sequence is not None:
        files = {"": files[sequence.first]}
    images = []
    for name, path in files.items():
        own_key = f"{key}:{name}" if name else key
        image = owned.block("images", own_key, partial(bpy.data.images.load, str(path), check_existing=False))
        image.source = "FILE"
        image.filepath = str(path)
        image.reload()
        # Blender learns what layers a file has by reading it, and must before a node can name one.
        _ = image.size[:]
        images.append(image)
    return images


def _count_through(tree: bpy.types.NodeTree, views: int, offsets: list[int], frame: int) -> None:
    """Timeline frame k shows file number k + offsets[k - 1]; `frame` is the current one."""
    for node in reading_nodes(tree):
        node.frame_start, node.frame_duration = 1, views
        path = f'nodes["{bpy.utils.escape_identifier(node.name)}"].frame_offset'
        compat.constant_keys(tree, path, offsets)
        if offsets:  # keys are only looked at when the frame changes
            node.frame_offset = offsets[min(max(frame, 1), views) - 1]
    node_of(tree, PASSES).use_auto_refresh = True


def _count_on(tree: bpy.types.NodeTree, first: int, last: int) -> None:
    """Each timeline frame shows the file of its number."""
    for node in reading_nodes(tree):
        node.frame_start, node.frame_duration, node.frame_offset = first, last - first + 1, first - 1
    node_of(tree, PASSES).use_auto_refresh = True


def _take_after(
    scene: bpy.types.Scene, shot: bpy.types.Scene, numbers: Sequence[int], size: tuple[int, int]
) -> None:
    """The frames, rate and pixels of the scene in which the shot was made. ``size`` is its files': of images with
    layers Blender does not always tell it."""
    scene.frame_start, scene.frame_end = min(numbers), max(numbers)
    scene.frame_step = math.gcd(*(number - min(numbers) for number in numbers)) or 1
    scene.frame_set(min(numbers))
    render = scene.render
    if 0 not in size:
        render.resolution_x, render.resolution_y = size
    for name in ("fps", "fps_base", "pixel_aspect_x", "pixel_aspect_y"):
        setattr(render, name, getattr(shot.render, name))


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
    scale.inputs[1].default_value, scale.inputs[2].default_value = 1.0 / width, compat.IN_A_PIXEL / width


def _new_palette(name: str, width: int) -> bpy.types.Image:
    return bpy.data.images.new(name, width, 1, alpha=True, float_buffer=True, is_data=True)


def _first_mattes(tree: bpy.types.NodeTree, result: LiftResult) -> None:
    """Something to see in the matte nodes at first sight."""
    if result.instances:
        first = result.instances[0]
        node_of(tree, INSTANCES).matte_id = matte_names({each.id: each.name for each in result.instances})[first.id]
        names = matte_names({each.id: each.name for each in result.classes.categories})
        node_of(tree, CLASSES).matte_id = names.get(first.class_id, "")


def _set_timeline(scene: bpy.types.Scene, result: LiftResult) -> None:
    """A frame and a marker for each view; the picture's size is the first view's."""
    scene.timeline_markers.clear()
    for frame, name in enumerate(result.passes, start=1):
        scene.timeline_markers.new(name, frame=frame)
    scene.frame_start, scene.frame_end = 1, len(result.passes)
    sizes = {frame.name: frame.size for frame in result.scene.frames}
    scene.render.resolution_x, scene.render.resolution_y = sizes[next(iter(result.passes))]
    scene.render.resolution_percentage = 100
