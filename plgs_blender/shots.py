"""A camera of the user's over a range of frames, as the engine bakes it: each frame a camera of its own.

The lift's world is Blender's: a camera sees the lifted scene from where it stands among the lift's objects.
"""

from __future__ import annotations

import difflib
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..engine.job import BakeCamera, JobError
from ..engine.job.cameras import safe_name, write_cameras
from ..engine.job.preview_request import LARGEST_SIDE, PreviewCamera
from ..engine.scene import Camera
from .frames import seen_by

DIGITS = 4
"""Of a frame's number in the names of its files; larger numbers have more."""
_LISTED = 8
"""Cameras named where another one was asked for: a lift has one a frame."""


@dataclass(frozen=True)
class Shot:
    """``camera`` from frame ``first`` to ``last``, every ``step``-th."""

    camera: bpy.types.Object
    first: int
    last: int
    step: int = 1

    @property
    def frames(self) -> range:
        return range(self.first, self.last + 1, self.step)


def shot_of(
    scene: bpy.types.Scene, camera: str = "", first: int | None = None, last: int | None = None, step: int | None = None
) -> Shot:
    """The camera of that name, or the scene's active one, over the range given or the scene's. Raises JobError."""
    ob = scene.objects.get(camera) if camera else scene.camera
    if ob is None or (camera and ob.type != "CAMERA"):
        what = f"has no camera named {camera!r}" if camera else "has no active camera"
        raise JobError(what, scene.name, _cameras_to_choose(scene, camera))
    shot = Shot(
        ob,
        scene.frame_start if first is None else first,
        scene.frame_end if last is None else last,
        scene.frame_step if step is None else step,
    )
    fix = "Set the range in the Output properties: from 0 on, its end not before its start."
    if not shot.frames or shot.first < 0:
        raise JobError(f"frames {shot.first} to {shot.last} are no range that can be baked", scene.name, fix)
    return shot


def _cameras_to_choose(scene: bpy.types.Scene, wanted: str) -> str:
    """What to do where ``wanted`` (empty: the active one) is no camera: the cameras that there are, those of a like
    name first, those of the lift's frames last."""
    cameras = [ob for ob in scene.objects if ob.type == "CAMERA"]
    if not cameras:
        return "Add a camera, select it and press Ctrl+Numpad 0."
    like = difflib.get_close_matches(wanted, [ob.name for ob in cameras])
    cameras.sort(key=lambda ob: (ob.name not in like, "frame" in ob, ob.name))
    names = ", ".join(repr(ob.name) for ob in cameras[:_LISTED])
    more = f" and {len(cameras) - _LISTED} more" if len(cameras) > _LISTED else ""
    return f"Choose one of its cameras: {names}{more}."


def write_shot(lift: Path, scene: bpy.types.Scene, shot: Shot) -> Path:
    """The file of cameras that an engine bakes the shot from, in the lift's folder. Raises JobError, OSError."""
    reader = ShotReader(scene, shot)
    reader.read_for(math.inf)
    return reader.write(lift)


class ShotReader:
    """Reads what a shot's camera sees at each frame, as it is animated, in pictures of the scene's size: its lens,
    shift, sensor, clip, and the scene's size, percentage and pixel aspect.

    Some frames at a time: Blender evaluates the scene at each, and a long range would keep its window from answering.
    Between two calls the scene stands where it stood. It and the camera are found again by their names: an undo
    meanwhile makes other objects of them.
    """

    def __init__(self, scene: bpy.types.Scene, shot: Shot) -> None:
        self._scene, self._camera, self._frames = scene.name, shot.camera.name, shot.frames
        self._read: list[BakeCamera] = []
        self._file = f"{safe_name(shot.camera.name)}.{shot.first}-{shot.last}.json"

    @property
    def progress(self) -> tuple[int, int]:
        """Frames that are read, and their number."""
        return len(self._read), len(self._frames)

    @property
    def cameras(self) -> list[BakeCamera]:
        """A camera that stands still is one camera, at the first frame."""
        stands_still = len({camera.fingerprint for camera in self._read}) == 1
        return self._read[:1] if stands_still else self._read

    def read_for(self, seconds: float) -> bool:
        """Read on for so long, a frame at least; whether all are read. Raises JobError for a camera that is no pinhole
        camera, or is gone."""
        end = time.monotonic() + seconds
        scene = bpy.data.scenes.get(self._scene)
        ob = None if scene is None else scene.objects.get(self._camera)
        if ob is None:
            raise JobError("is gone", f"{self._scene}: {self._camera}", "Bake it again.")
        with frame_kept(scene):
            for frame in self._frames[len(self._read) :]:
                name = f"{safe_name(self._camera)}.{frame:0{DIGITS}d}"
                self._read.append(_camera_at(scene, ob, frame, name))
                if time.monotonic() >= end:
                    break
        return len(self._read) == len(self._frames)

    def write(self, lift: Path) -> Path:
        """As `write_shot`, once all are read."""
        file = lift / "bake" / self._file
        write_cameras(file, self.cameras)
        return file


@contextmanager
def frame_kept(scene: bpy.types.Scene) -> Iterator[None]:
    """Go back to the current frame, and to its camera, at the end."""
    frame, part, camera = scene.frame_current, scene.frame_subframe, scene.camera
    try:
        yield
    finally:
        scene.frame_set(frame, subframe=part)
        scene.camera = camera


def refuse_no_pinhole(ob: bpy.types.Object, frame: int) -> None:
    """Raises JobError, in one line, for a camera whose picture no pinhole camera makes."""
    at = f"{ob.name}, frame {frame}"
    if ob.type != "CAMERA":
        raise JobError("is no camera", at, "Make a camera the scene's active one.")
    if ob.data.type != "PERSP":
        kind = {"ORTHO": "orthographic", "PANO": "panoramic"}.get(ob.data.type, ob.data.type.lower())
        raise JobError(f"is {kind}; only cameras in perspective can be baked", at, "Set its type to Perspective.")
    if ob.matrix_world.is_negative:
        raise JobError("shows the world mirrored", at, "Give it and its parents a scale above 0.")


def _camera_at(scene: bpy.types.Scene, ob: bpy.types.Object, frame: int, name: str) -> BakeCamera:
    scene.frame_set(frame)
    refuse_no_pinhole(ob, frame)
    camera = seen_by(ob, scene.render)
    if max(camera.width, camera.height) > LARGEST_SIDE:
        fix = f"Set its resolution to at most {LARGEST_SIDE} pixels a side."
        raise JobError(f"renders {camera.width}x{camera.height} pixels", scene.name, fix)
    return BakeCamera(name, _pinhole(camera), float(ob.data.clip_start), float(ob.data.clip_end))


def _pinhole(camera: Camera) -> PreviewCamera:
    pose = tuple(tuple(map(float, row)) for row in camera.camera_to_world)
    return PreviewCamera(pose, tuple(tuple(map(float, row)) for row in camera.K), camera.width, camera.height)
