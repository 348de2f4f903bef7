"""A user's camera over a frame range, as a bake needs it: each frame is a separate camera.

The lift's world is Blender's, so a camera sees the lifted scene from its position among the lift's objects.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..engine.errors import PlgsError
from ..engine.job import BakeCamera, write_atomically
from ..engine.job.cameras import LARGEST_SIDE, PreviewCamera, safe_name, write_cameras
from ..engine.job.follower import TaskFollower
from ..engine.job.lock import FileLock
from ..engine.job.task import TaskState
from ..engine.posed import Camera
from ..engine.records import read_record, record_text
from .cameras import seen_by
from .engine_environment import studio
from .passes import NOTES, VERSION, shot_name

DIGITS = 4
"""Minimum digits of the frame number in a file name."""
_CLAIM_S = 10.0  # seconds to wait while another bake claims a shot
_MOST_LATER = 100  # versions of a shot to try until one is free or shows the same
_MOST_OF_FILE = 50_000
"""Frames: the longest range that is taken from a file without having been asked for, half an hour at 25 a second."""
_LISTED = 8  # maximum number of cameras named in an error


@dataclass(frozen=True)
class Shot:
    """``camera`` at every ``step``-th frame from ``first`` to ``last``, or ``only`` at these, which may lie between
    whole ones. Its files are named ``given``, else after the .blend and the camera. ``motion``: whether the cameras one
    frame before and after each are wanted, too."""

    camera: bpy.types.Object
    first: int
    last: int
    step: int = 1
    given: str = ""
    only: tuple[float, ...] = ()
    motion: bool = False

    def named(self, later: int = 0) -> str:
        """The shot's name; its version, if any, is that of the .blend plus ``later``."""
        return shot_name(self.camera, self.given, later)

    @property
    def frames(self) -> Sequence[float]:
        return self.only or range(self.first, self.last + 1, self.step)

    @property
    def warnings(self) -> list[str]:
        """What Blender would render but a bake leaves out, and that the shot is not named as its file and camera."""
        scenes = self.camera.users_scene
        found = ["depth of field"] if self.camera.type == "CAMERA" and self.camera.data.dof.use_dof else []
        found += ["motion blur"] if any(scene.render.use_motion_blur for scene in scenes) else []
        warnings = [f"{what} is not baked: {self.camera.name} is sharp in the passes" for what in found]
        if any(scene.render.use_border and not scene.render.use_crop_to_border for scene in scenes):
            warnings.append("the render region is not cropped to, so whole pictures are baked")
        words = bpy.path.display_name_from_filepath(bpy.data.filepath), self.camera.name
        if not self.given and any(word not in self.named() for word in words):
            warnings.append(f"the names of the .blend and the camera do not fit: the shot is named {self.named()}")
        return warnings


def shot_of(
    scene: bpy.types.Scene,
    camera: str = "",
    *,
    first: int | None = None,
    last: int | None = None,
    step: int | None = None,
    given: str = "",
    only: Sequence[float] = (),
    motion: bool = False,
) -> Shot:
    """The named camera, or the active one, over the given range, else the scene's. ``given`` names its files, else
    the studio's default does. Raises PlgsError."""
    ob = scene.objects.get(camera) if camera else scene.camera
    if ob is None or (camera and ob.type != "CAMERA"):
        what = f"has no camera named {camera!r}" if camera else "has no active camera"
        raise PlgsError("no-camera", what, scene.name, _cameras_to_choose(scene, camera))
    is_files = not only and (first is None or last is None)
    if is_files and scene.frame_end - scene.frame_start >= _MOST_OF_FILE:
        what = f"has a range of {scene.frame_end - scene.frame_start + 1} frames, which nobody asked for"
        fix = "Say which frames to bake with --range, or set the range in the Output properties."
        raise PlgsError("long-range", what, scene.name, fix, option="--range")
    shot = Shot(
        ob,
        scene.frame_start if first is None else first,
        scene.frame_end if last is None else last,
        scene.frame_step if step is None else step,
        given or studio().names or "",
        tuple(only),
        motion,
    )
    if not shot.frames:
        what = f"cannot be baked: {shot.first} to {shot.last} is not a range of frames"
        fix = "Set the range in the Output properties: it must not end before it starts."
        raise PlgsError("bad-shot-range", what, scene.name, fix)
    return shot


def _cameras_to_choose(scene: bpy.types.Scene, wanted: str) -> str:
    """The fix if ``wanted`` (empty: the active one) is not a camera: those to choose from, the likeliest first."""
    cameras = [ob for ob in scene.objects if ob.type == "CAMERA"]
    if not cameras:
        return "Add a camera, select it and press Ctrl+Numpad 0."
    similar = difflib.get_close_matches(wanted, [ob.name for ob in cameras])
    cameras.sort(key=lambda ob: (ob.name not in similar, "frame" in ob, ob.name))
    names = ", ".join(repr(ob.name) for ob in cameras[:_LISTED])
    more = f" and {len(cameras) - _LISTED} more" if len(cameras) > _LISTED else ""
    return f"Choose one of its cameras: {names}{more}."


@dataclass(frozen=True)
class ShotSource:
    """The origin of a lift's shot: its ``camera`` in ``blend`` (unsaved: its Blender's temporary folder), and the
    fingerprints of the camera by names of ``frames``."""

    blend: str
    camera: str
    frames: dict[str, str] = field(default_factory=dict)

    @property
    def origin(self) -> tuple[str, str]:
        """The file, without the version in its name, and the camera."""
        return VERSION.sub("", self.blend), self.camera


@dataclass(frozen=True)
class _Claim:
    """The record of a shot in a folder, and its text ``before`` (empty: there was none) and after a bake began.
    ``made`` are the files and folders that are new."""

    path: Path
    before: str
    text: str
    made: Sequence[Path]

    def withdraw(self) -> None:
        """Leave all as it was, unless another bake has claimed more frames since then. Raises OSError, PlgsError."""
        lock = self.path.with_suffix(".lock")
        with FileLock(lock, _CLAIM_S):
            if self.path.read_text(encoding="utf-8") != self.text:
                return
            if self.before:
                write_atomically(self.path, self.before)
            for path in self.made:
                if path.is_file() and path != lock:
                    path.unlink()
        for path in self.made:
            if path.is_dir():
                path.rmdir()
            else:
                path.unlink(missing_ok=True)


def _claim(folder: Path, name: str, source: ShotSource, cameras: Path, *, replace: bool) -> _Claim:
    """Record in a folder which shot has this ``name`` and what its camera shows. Raises PlgsError if a bake would
    overwrite another shot, or one with another camera, unless ``replace``."""
    path, before = folder / f"{name}.shot.json", ""
    lock = path.with_suffix(".lock")
    made = [each for each in (path, cameras, lock, folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(lock, _CLAIM_S):  # others may begin to bake the same shot
        if path.exists():
            other = read_record(ShotSource, path, "Delete it, if no other file bakes a shot of this name.")
            if not replace:
                _refuse_other(folder, name, other, source)
            source = dataclasses.replace(source, frames=other.frames | source.frames)
            before = path.read_text(encoding="utf-8")
        text = record_text(source)
        if text != before:
            write_atomically(path, text)
    return _Claim(path, before, text, made)


def _refuse_other(folder: Path, name: str, other: ShotSource, source: ShotSource) -> None:
    if other.origin != source.origin:
        whose = "another camera of this file" if other.origin[0] == source.origin[0] else "another file"
        what = f"has a shot {name!r} of {whose} already: camera {other.camera!r} in {other.blend}"
        fix = "Give this one another name with --shot, or replace the other one with --replace."
        raise PlgsError("shot-taken", what, folder, fix, option="--shot --replace")
    changed = [frame for frame, seen in source.frames.items() if other.frames.get(frame, seen) != seen]
    if changed:
        what = f"has the shot {name!r} with another camera or size: {len(changed)} frames differ, such as {changed[0]}"
        fix = "Name the next version with --shot, as {version} in its name does, or replace this one with --replace."
        raise PlgsError("shot-changed", what, folder, fix, option="--shot --replace")


def write_view(lift: Path, scene: bpy.types.Scene) -> Path:
    """Write the active camera's current view into the lift's folder, and return the file. Raises PlgsError, OSError."""
    now = scene.frame_current
    ob = shot_of(scene, first=now, last=now, step=1).camera
    bpy.context.view_layer.update()  # a script may just have moved it
    name = numbered_name(safe_name(ob.name), now)
    write_cameras(lift / "bake" / f"{name}.json", [_camera_now(scene, ob, now, name)])
    return lift / "bake" / f"{name}.json"


def numbered_name(name: str, frame: float, digits: int = DIGITS) -> str:
    """A frame's file name, as in Blender's own renders: "shot.0003" and "shot.-0003". Half a frame later it is
    "shot.sub500.0003": programs count whole numbers only, so each part of a frame is a sequence of its own."""
    whole, part = divmod(round(1000 * frame), 1000)
    return f"{name}{f'.sub{part:03d}' if part else ''}.{'-' * (whole < 0)}{abs(whole):0{digits}d}"


class ShotReader:
    """Reads a shot's animated camera at each frame, as the scene renders it. It reads a few frames at a time, because
    Blender evaluates the scene at each frame, and a long range would freeze the window. Between two calls, the scene is
    at its original frame. Undo replaces the scene and the camera, so they are looked up by name."""

    def __init__(self, scene: bpy.types.Scene, shot: Shot) -> None:
        self._scene, self._camera, self._frames = scene.name, shot.camera.name, shot.frames
        self._read: list[BakeCamera] = []
        self._others: list[int] = []
        self._checked = 0
        self._names = [shot.named(later) for later in range(_MOST_LATER if "{version" in shot.given else 1)]
        self._shot = self._names[0]
        self._first = math.floor(min(*shot.frames, scene.frame_start))
        self._last = math.ceil(max(*shot.frames, scene.frame_end))
        self._motion, self._beside = shot.motion, dict[float, BakeCamera]()
        self._digits = max(DIGITS, *(len(str(abs(frame))) for frame in (self._first, self._last)))
        self._source = ShotSource(bpy.data.filepath or bpy.app.tempdir, shot.camera.name)
        which = f"{shot.first}-{shot.last}x{shot.step}"
        if shot.only:  # two lists of frames may be baked at once
            which = f"{shot.only[0]}-{shot.only[-1]}.{zlib.crc32(repr(shot.only).encode()):08x}"
        self._which = which
        self._stands_still: bool | None = None
        self._claimed: _Claim | None = None

    @property
    def progress(self) -> tuple[int, int]:
        """The number of frames read, and of all to read: of a camera that stands still, those outside the shot, too."""
        return len(self._read) + self._checked, len(self._frames) + len(self._others)

    @property
    def cameras(self) -> list[BakeCamera]:
        """The cameras read. If the camera is still over the scene's whole range, it is one camera, named after the
        range's first frame, so that it has the same name in all parts of a shot."""
        return [replace(each, name=numbered_name(self._shot, frame, self._digits)) for frame, each in self._shown]

    @property
    def _shown(self) -> list[tuple[float, BakeCamera]]:
        """The frames to bake, each with its camera."""
        if self._stands_still:
            return [(self._first, replace(self._read[0], frame=self._first))]
        return list(zip(self._frames, self._read, strict=False))

    def read_for(self, seconds: float) -> bool:
        """Continue reading for about ``seconds``, at least one frame. Returns whether it is done. Raises PlgsError."""
        end = time.monotonic() + seconds
        scene = bpy.data.scenes.get(self._scene)
        ob = None if scene is None else scene.objects.get(self._camera)
        if ob is None:
            raise PlgsError("camera-gone", "is gone", f"{self._scene}: {self._camera}", "Bake it again.")
        with _frame_kept(scene):
            if not self._read and not _may_move(scene, ob):  # no need to evaluate each frame
                self._read, self._stands_still = [_camera_at(scene, ob, self._first, "")], True
            while self._stands_still is None and self._read_one(scene, ob):
                if time.monotonic() >= end:
                    return False
        return True

    def _read_one(self, scene: bpy.types.Scene, ob: bpy.types.Object) -> bool:
        """Read the camera at one more frame. Returns whether any is left."""
        if len(self._read) < len(self._frames):
            self._read.append(self._camera_with_motion(scene, ob, self._frames[len(self._read)]))
            if len(self._read) < len(self._frames):
                return True
            is_short, taken = self._last - self._first < _MOST_OF_FILE, {*self._frames}
            if not is_short or len({each.fingerprint for each in self._read}) > 1:
                self._stands_still = False
                return False
            self._others = [each for each in range(self._first, self._last + 1) if each not in taken]
        else:
            seen = _camera_at(scene, ob, self._others[self._checked], "")
            self._checked += 1
            if seen.fingerprint != self._read[0].fingerprint:
                self._stands_still = False
                return False
        is_left = self._checked < len(self._others)
        self._stands_still = None if is_left else True
        return is_left

    def _camera_with_motion(self, scene: bpy.types.Scene, ob: bpy.types.Object, frame: float) -> BakeCamera:
        if not self._motion:
            return _camera_at(scene, ob, frame, "")
        around = (frame - 1, frame, frame + 1)
        self._beside = {each: self._beside.get(each) or _camera_at(scene, ob, each, "") for each in around}
        previous, now, following = self._beside.values()
        return replace(now, previous=previous.pinhole, next=following.pinhole)

    def write(self, lift: Path, *, replace: bool = False, output: Path | None = None) -> Path:
        """Once all frames are read: write the shot's cameras into the lift's folder or ``output``, and return the file.
        Raises PlgsError, OSError."""
        source = self._source
        if Path(source.blend).parent == lift:  # relative, as the folder may be moved
            source = ShotSource(Path(source.blend).name, source.camera)
        folder = lift / "bake" if output is None else output / NOTES
        for name in self._names:
            self._shot = name
            cameras = self.cameras
            shown = {numbered_name("", frame, 1)[1:]: camera.fingerprint for frame, camera in self._shown}
            file = folder / f"{name}.{self._which}.json"
            try:
                self._claimed = _claim(folder, name, dataclasses.replace(source, frames=shown), file, replace=replace)
            except PlgsError as error:
                if error.key != "shot-changed" or name == self._names[-1]:
                    raise
                continue
            break
        write_cameras(file, cameras)
        return file

    def withdraw_unbaked(self, bake: TaskFollower) -> None:
        """Undo `write` if the bake ended before its first view, as one does that the engine refuses."""
        if self._claimed is not None and bake.state is not TaskState.FINISHED and bake.progress.stage != "bake":
            with suppress(OSError, PlgsError):  # then a name stays taken, which another bake will say
                self._claimed.withdraw()


def _may_move(scene: bpy.types.Scene, ob: bpy.types.Object) -> bool:
    """Whether animation, drivers, constraints, physics or a script could change a camera's view over time."""
    ours, handlers = __package__.rpartition(".")[0], bpy.app.handlers
    scripts = [*handlers.frame_change_pre, *handlers.frame_change_post, *handlers.depsgraph_update_post]
    if any(not script.__module__.startswith(ours) for script in scripts):
        return True
    owners: list[Any] = [scene, ob.data]
    while ob is not None:
        owners.append(ob)
        if ob.constraints or ob.modifiers or ob.rigid_body is not None or ob.parent_type != "OBJECT":
            return True
        ob = ob.parent
        if ob is not None and ob.type != "EMPTY":  # such as a curve or an armature
            return True
    return any(each.animation_data is not None for each in owners)


@contextmanager
def _frame_kept(scene: bpy.types.Scene) -> Iterator[None]:
    """Restores the current frame and its camera at the end."""
    frame, part, camera = scene.frame_current, scene.frame_subframe, scene.camera
    try:
        yield
    finally:
        scene.frame_set(frame, subframe=part)
        scene.camera = camera


def _check_pinhole(ob: bpy.types.Object, frame: float) -> None:
    """Raises PlgsError for a camera that no pinhole camera can reproduce."""
    at = f"{ob.name}, frame {frame}"
    if ob.type != "CAMERA":
        raise PlgsError("not-a-camera", "is not a camera", at, "Make a camera the scene's active one.")
    if ob.data.type != "PERSP":
        kind = {"ORTHO": "orthographic", "PANO": "panoramic"}.get(ob.data.type, ob.data.type.lower())
        what = f"is {kind}; only perspective cameras can be baked"
        raise PlgsError("not-perspective", what, at, "Set its type to Perspective.")
    if ob.matrix_world.is_negative:
        raise PlgsError("mirrored", "shows the world mirrored", at, "Give it and its parents a positive scale.")


def _camera_at(scene: bpy.types.Scene, ob: bpy.types.Object, frame: float, name: str) -> BakeCamera:
    scene.frame_set(math.floor(frame), subframe=frame % 1)
    return _camera_now(scene, ob, frame, name)


def _camera_now(scene: bpy.types.Scene, ob: bpy.types.Object, frame: float, name: str) -> BakeCamera:
    _check_pinhole(ob, frame)
    camera, display = _rendered_part(seen_by(ob, scene.render), scene)
    if max(camera.width, camera.height) > LARGEST_SIDE:
        fix = f"Set its resolution to at most {LARGEST_SIDE} pixels per side."
        raise PlgsError("other-resolution", f"renders {camera.width}x{camera.height} pixels", scene.name, fix)
    near, far, fps = float(ob.data.clip_start), float(ob.data.clip_end), scene.render.fps / scene.render.fps_base
    pose, lens = (tuple(tuple(map(float, row)) for row in matrix) for matrix in (camera.camera_to_world, camera.K))
    pinhole = PreviewCamera(pose, lens, camera.width, camera.height)
    return BakeCamera(name, pinhole, near, far, math.floor(frame), fps, display)


def _rendered_part(camera: Camera, scene: bpy.types.Scene) -> tuple[Camera, tuple[int, int, int, int] | None]:
    """The camera of the baked picture: the render region if Blender crops to it, else the whole picture with EEVEE's
    overscan on all sides; and the picture's window within that. Raises PlgsError."""
    # A region that is not cropped would be a data window, which Blender's compositor misplaces (centred in 4.5, upside
    # down in 5.2), so the whole picture is baked then.
    render, (width, height) = scene.render, camera.size
    part, display = (0, 0, width, height), None
    if render.use_border and render.use_crop_to_border:
        left, right = (_pixels(each, width) for each in (render.border_min_x, render.border_max_x))
        bottom, top = (height - _pixels(each, height) for each in (render.border_min_y, render.border_max_y))
        if left >= right or top >= bottom:
            what = "has an empty render region"
            raise PlgsError("region-empty", what, scene.name, "Draw a larger one, or switch it off.")
        part = left, top, right, bottom
    elif scene.eevee.use_overscan:
        more = math.ceil(max(width, height) * scene.eevee.overscan_size / 100)
        part, display = (-more, -more, width + more, height + more), (more, more, width, height)
    left, top, right, bottom = part
    middle = camera.cx - left, camera.cy - top
    return Camera(right - left, bottom - top, camera.fx, camera.fy, *middle, camera.camera_to_world), display


def _pixels(share: float, size: int) -> int:
    """The pixels of a render border, counted as Blender does: in single precision, truncated."""
    return int(np.float32(share) * np.float32(size))
