"""Show a frame's photo, depth or masks in front of its camera's view, on demand, and the coloured cloud.

Blender's Python decodes neither depth nor masks, so an engine writes them as pictures into one folder per scene."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import fields
from hashlib import sha256
from itertools import chain
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.errors import PlgsError
from ..engine.job import LiftFolder
from ..engine.job.environment import notes_folder
from ..engine.known_scene import MadeFrame, MadeFrames, is_newer, made_of
from ..engine.posed import ClassTable
from ..engine.posed.array_file import read_npz
from ..engine.posed.frames import PosedFrame, PosedScene, SparsePoints
from ..engine.scene_source import SceneSource
from .cameras import PHOTO, SHOWN, put_before, show_photo
from .chosen_scene import ChosenScene, absolute
from .owned import FOLDER, LIFT, PLACE, SCENE, OwnedDataBlocks, lifts_in

_MOST_BESIDE = 9  # maximum number of frame folders beside a scene


def frames_folder(source: SceneSource) -> Path:
    """Return the folder for a scene's pictures, which may not exist yet. It lies beside the scene, as lifts do:
    "room_frames", or "room_frames_2" if another scene uses that. If that place is read-only, it lies in the user's
    cache. Raises PlgsError if no folder is left."""
    for folder in _candidates(source):
        try:
            made_of(folder, source)
        except PlgsError:
            continue
        return folder
    fix = "Delete the folders of frames beside the scene that are no longer needed."
    raise PlgsError("too-many", "there are too many folders of frames", source.scene.parent, fix)


def made_before(source: SceneSource) -> MadeFrames | None:
    """Return what an earlier run made of this scene, None without one. Raises PlgsError if its notes are damaged."""
    return made_of(frames_folder(source), source)


def photos(made: MadeFrames | None, frames: Iterable[PosedFrame] = ()) -> dict[str, Path]:
    """Return the photos that were made, by frame name, without those older than their source in ``frames``."""
    known = {} if made is None else made.frames
    found = {name: each.colour for name, each in known.items() if each.colour is not None and each.colour.is_file()}
    sources = {frame.name: frame.colour_path for frame in frames}
    return {name: path for name, path in found.items() if name not in sources or is_newer(path, sources[name])}


def is_depth_current(made: MadeFrames, name: str) -> bool:
    """Whether a frame's depth picture is newer than its source. (Only an engine knows the files of masks.)"""
    drawn = made.frames[name]
    stored = next((each for each in made.scene.frames if each.name == name), None)
    if stored is None or drawn.depth is None or drawn.depth_range is None:
        return False
    frame = stored.posed(made.source.scene)
    return is_newer(drawn.depth, frame.depth_path or frame.colour_path)


def cloud_of(made: MadeFrames | None, frames: Iterable[PosedFrame]) -> Path | None:
    """Return the file of the coloured cloud; None if none was made, or if the depth of ``frames`` is newer."""
    if made is None or made.cloud is None or not made.cloud.is_file():
        return None
    sources = {frame.depth_path for frame in frames if frame.depth_path is not None}
    return made.cloud if all(is_newer(made.cloud, source) for source in sources) else None


def has_cameras_of(made: MadeFrames, frames: Iterable[PosedFrame]) -> bool:
    """Whether an engine read the same cameras as ``frames`` has. Frames that only one of the two has are ignored, as
    the engine skips frames without a good mask or depth file, but they must share at least one frame."""
    cameras = {frame.name: frame.camera for frame in frames}
    both = [(cameras[stored.name], stored) for stored in made.scene.frames if stored.name in cameras]
    here = [(*one.size, one.fx, one.fy, one.cx, one.cy, *one.camera_to_world.ravel().tolist()) for one, _ in both]
    there = [(*stored.size, *stored.lens, *chain.from_iterable(stored.camera_to_world)) for _, stored in both]
    return bool(both) and np.allclose(here, there, rtol=0, atol=1e-4)


def scene_of(made: MadeFrames) -> PosedScene:
    """Return a scene as an engine read it: its frames' cameras and pictures, and the points of the reconstruction."""
    folder = made.source.scene
    points = None if made.points is None or not made.points.is_file() else SparsePoints(*read_cloud(made.points))
    scene = made.scene
    return PosedScene(folder, scene.posed_frames(folder), ClassTable(()), scene.warnings, scene.layout, points)


def read_cloud(path: Path) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Read a cloud: xyz float32 [N, 3] metres and rgb uint8 [N, 3] sRGB. Raises PlgsError for other files."""
    fix = "Delete the file and import the scene again."
    try:
        stored = read_npz(path, fix, ("xyz", "rgb"))
    except PlgsError as error:
        raise PlgsError(error.key, error.what, path, fix) from error
    xyz, rgb = stored["xyz"], stored["rgb"]
    if xyz.dtype != np.float32 or rgb.dtype != np.uint8 or xyz.shape != rgb.shape or xyz.shape[1:] != (3,):
        raise PlgsError("not-cloud", "is not a coloured cloud", path, fix)
    return xyz, rgb


def _candidates(source: SceneSource) -> Iterator[Path]:
    scene = source.scene
    name = f"{scene.stem if scene.is_file() else scene.name}_frames"
    if os.access(scene.parent, os.W_OK):
        yield scene.with_name(name)
        yield from (scene.with_name(f"{name}_{number}") for number in range(2, _MOST_BESIDE + 1))
    mark = sha256(repr(source).encode(errors="surrogateescape")).hexdigest()[:12]
    yield notes_folder() / "frames" / f"{name}-{mark}"


DEPTH, MASKS = "DEPTH", "MASKS"
KIND_OF = {DEPTH: "depth", MASKS: "masks", PHOTO: "colour"}
"""The engine's names of the pictures."""

_NEAR, _FAR = "near_metres", "far_metres"
"""Properties of a depth picture: the depths in metres of its lightest and darkest colour."""
_COLOURS = "colours"  # property of a mask picture: its colours as numbers


def why_no_picture(scene: bpy.types.Scene) -> str | None:
    """Return why nothing can be shown in front of the active camera, None if a picture can. Never reads the disk."""
    ob = scene.camera
    if ob is None or "frame" not in ob or LIFT not in ob:
        return "Look through a frame's camera first: select it and press Ctrl+Numpad 0"
    return None


def root_of(scene: bpy.types.Scene, ob: bpy.types.Object) -> bpy.types.Collection:
    """Return the collection of the import or lift that a frame's camera is of. Raises PlgsError for other cameras."""
    root = next((each for each in lifts_in(scene) if each[LIFT] == ob.get(LIFT)), None)
    if root is None:
        raise PlgsError("scene-gone", "does not belong to any scene in this file", ob.name, "Import the scene again.")
    return root


def place_of_root(root: bpy.types.Collection) -> ChosenScene:
    """Return the scene from which an import's or lift's frames come. Raises PlgsError if its lift folder is gone."""
    if root.get(FOLDER):
        request = LiftFolder.open(absolute(root[FOLDER])).request
        return ChosenScene(**{each.name: getattr(request, each.name) for each in fields(ChosenScene)})
    return ChosenScene.of(root[SCENE], **root.get(PLACE, {}))


def picture_file(made: MadeFrame, what: str) -> Path | None:
    """Return the photo, depth or masks that an engine made of a frame; None if the file is gone."""
    path = {PHOTO: made.colour, DEPTH: made.depth, MASKS: made.masks}[what]
    return path if path is not None and path.is_file() else None


def show_made(scene: bpy.types.Scene, ob: bpy.types.Object, what: str, made: MadeFrame) -> None:
    """Show the picture that an engine made of the camera's frame. Raises PlgsError if ``made`` lacks it."""
    path = picture_file(made, what)
    if path is None:
        raise PlgsError("no-pictures", f"has no {KIND_OF[what]}", ob["frame"], "Import the scene again.")
    owned = OwnedDataBlocks(root_of(scene, ob)[LIFT], scene)
    if what == PHOTO:
        show_photo(ob, owned, path, asked=True)
        return
    image, key = bpy.data.images.load(str(path), check_existing=False), f"{KIND_OF[what]}:{ob['frame']}"
    image.name = f"{KIND_OF[what].capitalize()} {ob['frame']}"
    owned.drop("images", key)
    owned.block("images", key, lambda: image)
    if what == DEPTH and made.depth_range is not None:
        image[_NEAR], image[_FAR] = made.depth_range
    if what == MASKS:
        width, height = image.size
        pixels = np.empty((height, width, 4), np.float32)
        image.pixels.foreach_get(pixels.ravel())
        # Areas of fewer than four pixels need no place in the legend.
        image[_COLOURS] = np.unique(colour_numbers(pixels[::2, ::2, :3].reshape(-1, 3))).tolist()
    put_before(ob, image, what, 1.0)


def colour_numbers(srgb: NDArray[np.floating]) -> NDArray[np.int32]:
    """Encode colours [N, 3], 0..1, as one number each, 0xRRGGBB, int32 [N]."""
    red, green, blue = np.rint(255.0 * srgb).astype(np.int32).T
    return red << 16 | green << 8 | blue


def colours_shown(ob: bpy.types.Object) -> set[int] | None:
    """Return the colours, as numbers, of the masks in front of a camera; None if unknown."""
    image = ob.data.background_images[0].image if ob.data.background_images else None
    return None if image is None or _COLOURS not in image else {*image[_COLOURS]}


def range_shown(ob: bpy.types.Object) -> tuple[float, float] | None:
    """The depths in metres of the lightest and darkest colour in front of a camera; None if no depth is shown."""
    if ob.get(SHOWN) != DEPTH or not ob.data.background_images:
        return None
    image = ob.data.background_images[0].image
    return None if image is None or _NEAR not in image else (image[_NEAR], image[_FAR])
