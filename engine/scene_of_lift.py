"""The scene of a lift with its pixels, where its request says; where it was moved, its cameras alone."""

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
from .known_scene import FIND_SCENE, has_known, known_scene, read_known, write_known
from .scene import Camera, Frame, OtherClasses, PosedFrame, Scene, open_asked

_ALIKE = 1e-4
"""Metres, pixels and entries of rotations by which the cameras of the same frames may differ."""


def scene_of_lift(folder: LiftFolder) -> Scene:
    """The scene that a lift was made from. Where it is gone, its frames and cameras with the classes of the result:
    enough to place, bake and export what needs no pictures; their readers raise.

    Raises PlgsError for a scene that is there and cannot be read, or is gone and not known.
    """
    if os.path.exists(folder.request.scene) or not has_known(folder.path):
        return open_asked(folder.request)
    known, gone = known_scene(folder), _gone(folder.request.scene)
    frames = tuple(
        Frame(each.name, each.camera, each.held_out, each.colour_path, None, gone, gone, gone, file_shows_colour=False)
        for each in known.frames
    )
    return Scene(known.folder, frames, known.classes, known.warnings)


def names_of_frames(folder: LiftFolder) -> tuple[str, ...]:
    """The names of all frames of a lift's scene; none where they are not known. Raises PlgsError."""
    known = read_known(folder)
    return () if known is None else tuple(frame.name for frame in known.frames)


def remember_scene(folder: LiftFolder, scene: Scene) -> None:
    """Write the cameras of a lift's scene, and the digest of its masks, beside its request. Raises PlgsError for a mask
    with unknown classes, OSError."""
    write_known(folder, scene, digest_of_masks(scene))


def complete_known_scene(folder: LiftFolder, scene: Scene) -> None:
    """Write scene.json again where an earlier version wrote it without what Blender needs, or not at all."""
    known = read_known(folder)
    if os.path.exists(scene.folder) and (known is None or not known.layout):
        write_known(folder, scene, "" if known is None else known.masks)


def is_done(folder: LiftFolder) -> bool:
    """Whether nothing is left to lift, for a caller who knows that no engine is at work: the result is there, as it was
    written byte by byte, and the masks are those that it was lifted from. Raises PlgsError.
    """
    is_finished = folder.state_at_rest() is LiftState.FINISHED
    return is_finished and folder.is_whole() and not have_masks_changed(folder)


def masks_last_run(folder: LiftFolder) -> str:
    """The digest of the masks when the lift was last run; empty where that is not known. Raises PlgsError."""
    known = read_known(folder)
    return "" if known is None else known.masks


def have_masks_changed(folder: LiftFolder, scene: Scene | None = None) -> bool:
    """Whether the masks of a lift's ``scene``, opened where it is not given, differ from those when the lift was last
    run. False where that is not known, or the scene is gone. Raises PlgsError."""
    masks = masks_last_run(folder)
    if not masks or not os.path.exists(folder.request.scene):
        return False
    return masks != digest_of_masks(scene or open_asked(folder.request))


def digest_of_masks(scene: Scene) -> str:
    """SHA-256 of the masks of all frames with their segments. Raises OtherClasses."""
    found = sha256()
    for frame in scene.frames:
        if frame.read_mask is not None:
            try:
                mask = frame.mask()
            except OtherClasses:
                raise
            except PlgsError:  # the check leaves this frame out
                found.update(f"{frame.name} is unreadable".encode())
                continue
            found.update(f"{frame.name} {mask.segments}".encode())
            found.update(np.ascontiguousarray(mask.ids).tobytes())
    return found.hexdigest()


def relink(folder: LiftFolder, place: Path) -> LiftFolder:
    """Let a lift's request name its scene at another ``place``. Masks and depth maps that lay in it move along.

    Raises PlgsError when a program works on the lift, when what is there cannot be read, or has other frames: other
    names, sizes, lenses or poses. Then the request stays as it was.
    """
    if folder.is_running:
        raise PlgsError("an engine is at work here", folder.path, "Wait for it, or cancel it.", code=ErrorCode.BUSY)
    request, place = folder.request, place.absolute()
    masks, depth = (_moved(path, request.scene, place) for path in (request.masks, request.depth))
    found = replace(request, scene=place, masks=masks, depth=depth)
    scene = open_asked(found)
    known = read_known(folder)
    if known is not None:
        refuse_others(known.posed_frames(place), scene)
    write_atomically(folder.path / "request.json", found.to_json(folder.path))
    return LiftFolder.open(folder.path)


def refuse_others(known: Sequence[PosedFrame], scene: Scene) -> None:
    """Raise PlgsError where a scene has other frames than those that are known."""
    there = {frame.name: frame for frame in scene.frames}
    for frame in known:
        if frame.name not in there:
            raise PlgsError(f"this is another scene: it has no frame {frame.name}", scene.folder, FIND_SCENE)
        if not _is_same(frame.camera, there[frame.name].camera):
            raise PlgsError(f"this is another scene: the camera of {frame.name} differs", scene.folder, FIND_SCENE)


def _gone(scene: Path) -> Callable[[Any], NoReturn]:
    """A reader of pixels that are not there."""

    def read(size: Any = None) -> NoReturn:
        raise PlgsError("the scene is not there, and this needs its pictures", scene, FIND_SCENE, option="--scene")

    return read


def _is_same(one: Camera, other: Camera) -> bool:
    same_pose = np.allclose(one.camera_to_world, other.camera_to_world, rtol=0, atol=_ALIKE)
    return one.size == other.size and same_pose and np.allclose(one.K, other.K, rtol=0, atol=_ALIKE)


def _moved(path: Path | None, old: Path, new: Path) -> Path | None:
    return new / path.relative_to(old) if path is not None and path.is_relative_to(old) else path
