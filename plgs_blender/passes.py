"""Scenes with the baked passes as compositor layers: one for the lift's frames, and one for each baked user camera.

In the scene of the lift's frames, each timeline frame is one view. The EXR files are an image sequence with gaps in its
numbers, and a keyed offset maps frames to files. If the names are not numbered, `show_view` swaps images."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.errors import PlgsError
from ..engine.job.cameras import LARGEST_SIDE, safe_name
from ..engine.job.manifest import MAKE_ANEW
from ..engine.posed.exr_header import one_pixel_of, read_exr_header
from ..engine.posed.names import matte_names
from . import compat
from .materials import linear_rgba
from .owned import KEY, LIFT, OwnedDataBlocks, key_of, lifts_in, tag, text_of
from .pass_nodes import (
    COLOURS,
    CONTROLS,
    CRYPTO_CLASSES,
    CRYPTO_INSTANCES,
    PANOPTIC,
    PASSES,
    build,
    has_nodes,
    node_of,
    reading_nodes,
    use_image,
)
from .results import LiftResult
from .shot_names import BEFORE_0, NumberedNames, numbered, sequences, shot_name

SHOT = "shot:"
"""Start of the key of a scene with the passes of a user's camera."""
NOTES = ".plgs"
"""The hidden folder beside a shot's passes for its origin, cameras and locks."""
_NEEDED = {*(f"PLGS.{layer}" for layer in ("Combined.R", "Depth.V", "Semantic.V", "Instance.V"))}
_NEEDED |= {"CryptoInstance00.r", "CryptoClass00.r"}


def check_layers(files: Iterable[Path]) -> None:
    """Raise PlgsError if one of the passes' files is not an EXR or lacks a layer that the compositor reads."""
    for path in files:
        try:
            missing = _NEEDED - {*read_exr_header(path).channels}
        except PlgsError as error:
            raise PlgsError(error.key, f"is damaged ({error.what})", path, MAKE_ANEW) from error
        if missing:
            raise PlgsError("no-layer", f"has no layer {min(missing)}", path, MAKE_ANEW)


def size_of(path: Path) -> tuple[int, int]:
    """Return width and height of a passes file in pixels; 0, 0 if it is no EXR or too large."""
    try:
        size = read_exr_header(path).size
    except PlgsError:
        return 0, 0
    return size if max(size) <= LARGEST_SIDE else (0, 0)


def place_passes(owned: OwnedDataBlocks, result: LiftResult) -> bpy.types.Scene | None:
    """Make or refill the scene "PLGS <name> passes" and return it; None if the lift's frames have no passes."""
    if not result.passes:
        owned.drop("scenes", PASSES)
        return None
    sequence = numbered([path.stem for path in result.passes.values()])
    scene = _fill_scene(
        owned, result, PASSES, files=result.passes, sequence=sequence, count=_counting_through(result.passes, sequence)
    )
    _mark_views(scene, result.passes)
    sizes = {frame.name: frame.size for frame in result.scene.frames}
    scene.render.resolution_x, scene.render.resolution_y = sizes[next(iter(result.passes))]
    scene.render.resolution_percentage = 100
    return scene


def place_shots(owned: OwnedDataBlocks, result: LiftResult, shot_scene: bpy.types.Scene) -> list[bpy.types.Scene]:
    """Make or refill a scene "PLGS <name> <camera>" for each baked user camera; these cameras move in `shot_scene`."""
    groups = sequences(list(result.shots))
    for scene in list(bpy.data.scenes):
        key = key_of(scene, owned.lift) or ""
        if key.startswith(SHOT) and key.removeprefix(SHOT) not in groups:
            owned.drop("scenes", key)
    scenes = []
    for camera, names in groups.items():
        is_before_0 = BEFORE_0.fullmatch(names[0]) is not None
        files = {name: result.shots[name] for name in sorted(names, reverse=is_before_0)}  # -0002 before -0001
        sequence = numbered(list(files))
        numbers = (1,) if sequence is None else sequence.numbers
        count = _counting_through(files, sequence) if is_before_0 else partial(_count_on, min(numbers), max(numbers))
        scene = _fill_scene(owned, result, f"{SHOT}{camera}", files=files, sequence=sequence, count=count)
        _take_after(scene, shot_scene, range(1, 1 + len(files)) if is_before_0 else numbers, size_of(files[names[0]]))
        if is_before_0:
            _mark_views(scene, files)
        scenes.append(scene)
    return scenes


def _counting_through(names: Collection[str], sequence: NumberedNames | None) -> Callable[[Any, Any], None]:
    """Return a function that makes timeline frame k show the k-th of these names, whose numbers ``sequence`` gives."""
    numbers = () if sequence is None else sequence.numbers
    return partial(_count_through, len(names), [number - k for k, number in enumerate(numbers, start=1)])


def _fill_scene(
    owned: OwnedDataBlocks,
    result: LiftResult,
    key: str,
    *,
    files: Mapping[str, Path],
    sequence: NumberedNames | None,
    count: Callable[[bpy.types.Scene, bpy.types.NodeTree], None],
) -> bpy.types.Scene:
    """Make if missing, fill and return our scene `key`, whose nodes show the files. ``count`` is called with the scene
    and its nodes, and maps timeline frames to files; ``sequence`` gives the files' numbers, or is None without any."""
    name = f"PLGS {result.name} {key.removeprefix(SHOT)}"
    scene = owned.block("scenes", key, lambda: _new_scene(name))
    scene.name = name
    image = _images(owned, key, files, sequence)
    tree = compat.compositor_tree(scene)
    with _one_pixel_of(image):
        if tree is None or not has_nodes(tree):
            tree = compat.new_compositor_tree(scene, name)
            build(tree, owned.lift, image)
            _begin_matte(owned.lift, scene, tree, result)
        if not tree.is_embedded_data:
            tag(tree, owned.lift, f"{key} tree")
            owned.keep(tree)
        use_image(tree, image)
        if sequence is not None:
            image.source = "SEQUENCE"  # after its layers were chosen, which only works on a single file
        count(scene, tree)
    _fill_palette(owned, tree, "Instance", {each.id: each.colour for each in result.instances})
    _fill_palette(owned, tree, "Class", {each.id: each.colour for each in result.classes.categories})
    return scene


def _begin_matte(lift: str, scene: bpy.types.Scene, tree: bpy.types.NodeTree, result: LiftResult) -> None:
    """Give new nodes the matte and controls of the last compositor, else a matte of the selected object, else none."""
    layers = (CRYPTO_INSTANCES, CRYPTO_CLASSES)
    for other in reversed(bpy.data.scenes):
        last = compat.compositor_tree(other) if other != scene and key_of(other, lift) else None
        if last is not None and has_nodes(last) and any(node_of(last, layer).matte_id for layer in layers):
            for layer in layers:
                node_of(tree, layer).matte_id = node_of(last, layer).matte_id
            groups = [node for each in (tree, last) for node in each.nodes if node.get(KEY) == PANOPTIC]
            for name in (*CONTROLS, *COLOURS) if len(groups) == 2 else ():
                groups[0].inputs[name].default_value = groups[1].inputs[name].default_value
            return
    for root in (root for each in bpy.data.scenes for root in lifts_in(each) if root[LIFT] == lift):
        lists = getattr(root, "plgs", None)  # None while the extension is off
        if lists is not None and 0 <= lists.instance_index < len(lists.instances):
            row = lists.instances[lists.instance_index]
            names = (matte_names({each.id: each.name for each in kind})
                     for kind in (result.instances, result.classes.categories))  # fmt: skip
            for layer, known, number in zip(layers, names, (row.instance_id, row.class_id), strict=True):
                node_of(tree, layer).matte_id = known.get(number, "")


def _new_scene(name: str) -> bpy.types.Scene:
    """Make a scene only for compositing: no camera, nothing rendered, colours unchanged."""
    scene = bpy.data.scenes.new(name)
    compat.show_stored_colours(scene)
    scene.render.use_compositing, scene.render.use_sequencer = True, False
    scene.render.image_settings.file_format = "PNG"
    compat.composite_without_gpu(scene)
    return scene


def _images(
    owned: OwnedDataBlocks, key: str, files: Mapping[str, Path], sequence: NumberedNames | None
) -> bpy.types.Image:
    """Make images that read the files, without loading any: one of a sequence, or one per file. Returns the first."""
    if sequence is not None:
        files = {"": next(path for path in files.values() if path.stem == sequence.first)}
    images = []
    for name, path in files.items():
        own_key = f"{key}:{name}" if name else key
        image = owned.block("images", own_key, partial(bpy.data.images.load, str(path), check_existing=False))
        image.filepath_raw = str(path)
        image.buffers_free()
        images.append(image)
    return images[0]


@contextmanager
def _one_pixel_of(image: bpy.types.Image) -> Iterator[None]:
    """Temporarily give an image one pixel with its file's layers, because Blender rereads it for each layer."""
    path = image.filepath
    with tempfile.TemporaryDirectory(prefix="plgs-", dir=bpy.app.tempdir) as folder:
        pixel = Path(folder) / "0001.exr"
        pixel.write_bytes(one_pixel_of(Path(path)))
        image.filepath_raw = str(pixel)  # setting `source` reads the file
        image.source, image.filepath = "FILE", str(pixel)
        try:
            yield
        finally:
            image.filepath_raw = path
            image.buffers_free()


def _count_through(views: int, offsets: list[int], scene: bpy.types.Scene, tree: bpy.types.NodeTree) -> None:
    """Make timeline frame k show file number k + offsets[k - 1]."""
    for node in reading_nodes(tree):
        node.frame_start, node.frame_duration = 1, views
        path = f'nodes["{bpy.utils.escape_identifier(node.name)}"].frame_offset'
        action = tree.animation_data_create().action or bpy.data.actions.new(f"{tree.name} frames")
        compat.add_keys(
            tree, action, path, frames=np.arange(1.0, len(offsets) + 1.0), values=np.array(offsets),
            interpolation="CONSTANT",
        )  # fmt: skip
        if offsets:  # keys are evaluated only when the frame changes
            node.frame_offset = offsets[min(max(scene.frame_current, 1), views) - 1]
    node_of(tree, PASSES).use_auto_refresh = True


def _count_on(first: int, last: int, _scene: bpy.types.Scene, tree: bpy.types.NodeTree) -> None:
    """Make each timeline frame show the file with its number, from ``first`` to ``last``."""
    for node in reading_nodes(tree):
        node.frame_start, node.frame_duration, node.frame_offset = first, last - first + 1, first - 1
    node_of(tree, PASSES).use_auto_refresh = True


def _take_after(scene: bpy.types.Scene, shot: bpy.types.Scene, numbers: Sequence[int], size: tuple[int, int]) -> None:
    """Give a passes scene the range of the files' ``numbers``, their ``size``, and ``shot``'s rate and pixel aspect."""
    scene.frame_start, scene.frame_end = min(numbers), max(numbers)
    scene.frame_step = math.gcd(*(number - min(numbers) for number in numbers)) or 1  # 0 if there is only one
    scene.frame_set(min(numbers))
    render = scene.render
    if 0 not in size:
        render.resolution_x, render.resolution_y = size
    for name in ("fps", "fps_base", "pixel_aspect_x", "pixel_aspect_y"):
        setattr(render, name, getattr(shot.render, name))


def _fill_palette(
    owned: OwnedDataBlocks, tree: bpy.types.NodeTree, what: str, colours: Mapping[int, tuple[int, int, int]]
) -> None:
    """Write the colours, sRGB by id, into the linear palette image, and scale ids to its width."""
    width = max(colours, default=0) + 1
    name, new = f"PLGS {what.lower()} palette", bpy.data.images.new
    image = owned.block(
        "images", f"{what} palette", lambda: new(name, width, 1, alpha=True, float_buffer=True, is_data=True)
    )
    if image.size[0] != width:
        image.scale(width, 1)
    pixels: NDArray[np.float32] = np.zeros((width, 4), np.float32)
    pixels[:, 3] = 1.0
    for number, colour in colours.items():
        pixels[number] = linear_rgba(colour)
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.pack()  # it has no file, so it would be lost on saving
    node_of(tree, f"{what} palette").image = image
    scale = node_of(tree, f"{what} scale")
    scale.inputs[1].default_value, scale.inputs[2].default_value = 1.0 / width, compat.IN_A_PIXEL / width


def _mark_views(scene: bpy.types.Scene, names: Collection[str]) -> None:
    scene.timeline_markers.clear()
    for frame, name in enumerate(names, start=1):
        scene.timeline_markers.new(name, frame=frame)
    scene.frame_start, scene.frame_end = 1, len(names)


def open_passes(scene: bpy.types.Scene) -> bpy.types.Scene:
    """Return the passes scene, at the active camera's view if that was baked. Raises PlgsError without passes."""
    passes = passes_scene_of(scene)
    if passes is None:
        raise PlgsError("no-passes", "has no passes", scene.name, "Bake them in the Passes panel.")
    camera = scene.camera
    frame = text_of(camera, "frame") if camera is not None else ""
    if frame in {marker.name for marker in passes.timeline_markers}:
        show_view(passes, frame)
    elif is_shot(passes) and passes.frame_start <= scene.frame_current <= passes.frame_end:
        passes.frame_set(scene.frame_current)
    return passes


def is_shot(scene: bpy.types.Scene) -> bool:
    """Whether a scene holds the passes of a user camera."""
    return bool(text_of(scene, LIFT)) and (key_of(scene, scene[LIFT]) or "").startswith(SHOT)


def passes_scene_of(scene: bpy.types.Scene) -> bpy.types.Scene | None:
    """Return the scene itself if it holds passes, else a passes scene of its first lift: the active camera's, the
    lift's frames', or any; None without one."""
    if text_of(scene, LIFT) and (key_of(scene, scene[LIFT]) == PASSES or is_shot(scene)):
        return scene
    for root in lifts_in(scene):
        found = {key_of(other, root[LIFT]) or "": other for other in bpy.data.scenes}
        shots = [key for key in found if key.startswith(SHOT)]
        named = () if scene.camera is None else (shot_name(scene.camera.name), safe_name(scene.camera.name))
        own = [SHOT + next(iter(sequences([f"{name}.0001"]))) for name in named]  # with or without the file's name
        for key in (*own, PASSES, *shots):
            if key in found:
                return found[key]
    return None


def show_view(scene: bpy.types.Scene, name: str) -> None:
    """Show the passes of the view `name` in a passes scene. Raises KeyError if there is no such view."""
    frames = {marker.name: marker.frame for marker in scene.timeline_markers}
    tree = compat.compositor_tree(scene)
    scene.frame_set(frames[name])
    for image in bpy.data.images:
        if image.get(LIFT) == scene[LIFT] and image.get(KEY) == f"{PASSES}:{name}":
            use_image(tree, image)
    number = numbered([name])
    if number is not None and node_of(tree, PASSES).image.source == "SEQUENCE":
        for node in reading_nodes(tree):  # Blender evaluates keys only of the scene that its window shows
            node.frame_offset = number.numbers[0] - frames[name]
