"""The scene of a lift: where its request says, else, when it was moved, its cameras as scene.json keeps them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from .errors import ErrorCode, PlgsError
from .job import LiftFolder, LiftState, write_atomically
from .json_file import read_object, take_objects, to_text
from .result_files import INSTANCES, read_instances
from .scene import Camera, Frame, Scene, open_asked

KNOWN_SCENE = "scene.json"
"""File of a lift folder: the frames of its scene with their cameras."""
FORMAT = 1
_FIX = "Delete this file; a lift needs it only where its scene is not."
_FIND = "Name where the scene now is: Find Scene, or --scene."
_ALIKE = 1e-4
"""Metres, pixels and entries of rotations by which the cameras of the same frames may differ."""


def scene_of_lift(folder: LiftFolder) -> Scene:
    """The scene that a lift was made from. Where it is gone, its frames and cameras with the classes of the result:
    enough to place, bake and export what needs no pictures; their readers raise.

    Raises PlgsError for a scene that is there and cannot be read, or is gone and not known.
    """
    if os.path.exists(folder.request.scene) or not (folder.path / KNOWN_SCENE).is_file():
        return open_asked(folder.request)
    gone = folder.request.scene
    frames = tuple(replace(frame, colour_path=gone / frame.colour_path) for frame in known_frames(folder))
    classes, _ = read_instances(folder.result_path / INSTANCES)
    return Scene(gone, frames, classes, warnings=(f"the scene is not at {gone}: no photos. {_FIND}",))


def remember_scene(folder: LiftFolder, scene: Scene) -> None:
    """Write the cameras of a lift's scene, and what its masks are known by, beside its request. Raises PlgsError for
    a mask that cannot be read, OSError."""
    frames = [_content(frame, scene.folder) for frame in scene.frames]
    content = {"format": FORMAT, "masks": digest_of_masks(scene), "frames": frames}
    write_atomically(folder.path / KNOWN_SCENE, to_text(content))


def is_done(folder: LiftFolder) -> bool:
    """Whether nothing is left to lift, for a caller who knows that no engine is at work: the result is there, as it was
    written byte by byte, and the masks are those that it was lifted from. Raises PlgsError.
    """
    is_finished = folder.state_at_rest() is LiftState.FINISHED
    return is_finished and folder.is_whole() and not have_masks_changed(folder)


def have_masks_changed(folder: LiftFolder, scene: Scene | None = None) -> bool:
    """Whether masks of a lift's ``scene``, opened where it is not given, are others than when the lift was last run.
    False where that is not known, or the scene is gone. Raises PlgsError."""
    if not (folder.path / KNOWN_SCENE).is_file() or not os.path.exists(folder.request.scene):
        return False
    known = _known_content(folder).get("masks")
    return bool(known) and known != digest_of_masks(scene or open_asked(folder.request))


def digest_of_masks(scene: Scene) -> str:
    """SHA-256 of the masks of all frames with their segments. Raises PlgsError."""
    found = sha256()
    for frame in scene.frames:
        if frame.read_mask is not None:
            mask = frame.mask()
            found.update(f"{frame.name} {mask.segments}".encode())
            found.update(np.ascontiguousarray(mask.ids).tobytes())
    return found.hexdigest()


def relink(folder: LiftFolder, place: Path) -> LiftFolder:
    """Let a lift's request name its scene at another ``place``. Masks and depth maps that lay in it move along.

    Raises PlgsError when a program works at the lift, when what is there cannot be read, or has other frames: other
    names, sizes, lenses or poses. Then the request stays as it was.
    """
    if folder.is_running:
        raise PlgsError("an engine is at work here", folder.path, "Wait for it, or cancel it.", code=ErrorCode.BUSY)
    request, place = folder.request, place.absolute()
    masks, depth = (_moved(path, request.scene, place) for path in (request.masks, request.depth))
    found = replace(request, scene=place, masks=masks, depth=depth)
    scene = open_asked(found)
    if (folder.path / KNOWN_SCENE).is_file():
        refuse_others(known_frames(folder), scene)
    write_atomically(folder.path / "request.json", found.to_json(folder.path))
    return LiftFolder.open(folder.path)


def refuse_others(known: Sequence[Frame], scene: Scene) -> None:
    """Raise PlgsError where a scene has other frames than those that are known."""
    there = {frame.name: frame for frame in scene.frames}
    for frame in known:
        if frame.name not in there:
            raise PlgsError(f"is another scene: it has no frame {frame.name}", scene.folder, _FIND)
        if not _is_same(frame.camera, there[frame.name].camera):
            raise PlgsError(f"is another scene: the camera of frame {frame.name} differs", scene.folder, _FIND)


def known_frames(folder: LiftFolder) -> list[Frame]:
    """The frames of scene.json; paths of pictures are relative to the scene. Raises PlgsError for a damaged file."""
    path, content = folder.path / KNOWN_SCENE, _known_content(folder)
    try:
        return [_frame(entry, folder.request.scene) for entry in take_objects(content, "frames", "the scene", path)]
    except (KeyError, TypeError, ValueError) as error:
        raise PlgsError(f"a frame cannot be read ({error})", path, _FIX) from error


def _known_content(folder: LiftFolder) -> dict[str, Any]:
    path = folder.path / KNOWN_SCENE
    content = read_object(path, _FIX)
    if content.get("format") != FORMAT:
        what = f"has format {content.get('format')!r}, this version reads {FORMAT}"
        raise PlgsError(what, path, "Use the version of PLGS that wrote it.")
    return content


def _content(frame: Frame, scene: Path) -> dict[str, object]:
    camera, colour = frame.camera, frame.colour_path
    return {
        "name": frame.name,
        "held_out": frame.held_out,
        "size": list(camera.size),
        "lens": [camera.fx, camera.fy, camera.cx, camera.cy],
        "camera_to_world": camera.camera_to_world.tolist(),
        "colour": colour.relative_to(scene).as_posix() if colour.is_relative_to(scene) else str(colour),
    }


def _frame(entry: dict[str, Any], scene: Path) -> Frame:
    """Raises KeyError, TypeError, ValueError."""
    width, height = map(int, entry["size"])
    fx, fy, cx, cy = map(float, entry["lens"])
    pose = np.array(entry["camera_to_world"], np.float64).reshape(4, 4)
    if not np.isfinite([fx, fy, cx, cy, *pose.ravel()]).all() or min(width, height) < 1:
        raise ValueError("no camera")
    name, colour = str(entry["name"]), Path(str(entry["colour"]))
    camera, gone = Camera(width, height, fx, fy, cx, cy, pose), _gone(scene)
    return Frame(name, camera, bool(entry["held_out"]), colour, None, gone, gone, gone, file_shows_colour=False)


def _gone(scene: Path) -> Callable[[Any], NoReturn]:
    """A reader of pixels that are not there."""

    def read(size: Any = None) -> NoReturn:
        raise PlgsError("the scene is not there, and this needs its pictures", scene, _FIND, option="--scene")

    return read


def _is_same(one: Camera, other: Camera) -> bool:
    same_pose = np.allclose(one.camera_to_world, other.camera_to_world, rtol=0, atol=_ALIKE)
    return one.size == other.size and same_pose and np.allclose(one.K, other.K, rtol=0, atol=_ALIKE)


def _moved(path: Path | None, old: Path, new: Path) -> Path | None:
    return new / path.relative_to(old) if path is not None and path.is_relative_to(old) else path
