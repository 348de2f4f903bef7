"""A user's camera over a range of frames, in the form that a bake needs: each frame is a separate camera. The lift's
world is Blender's, so a camera sees the lifted scene from its position among the lift's objects."""

from __future__ import annotations

import dataclasses
import difflib
import math
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..engine.errors import PlgsError
from ..engine.job import BakeCamera
from ..engine.job.cameras import LARGEST_SIDE, PreviewCamera, safe_name, write_cameras
from ..engine.job.follower import TaskFollower
from ..engine.job.task import TaskState
from ..engine.posed import Camera
from ..engine.posed.layout import listed
from .cameras import panorama_of, seen_by
from .engine_environment import studio
from .passes import NOTES
from .shot_names import shot_name
from .shot_notes import Claim, ShotSource, claim, next_version
from .timeline import is_of_lift

CUTS = "cuts"
"""What a shot is named after whose camera markers switch."""
DIGITS = 4
"""Minimum digits of the frame number in a file name."""
_MOST_LATER = 100  # versions of a shot to try until one is free or shows the same
_MOST_OF_FILE = 50_000
"""Frames: the longest range that is taken from a file without having been asked for, half an hour at 25 a second."""
_LISTED = 8  # maximum number of cameras named in an error


@dataclass(frozen=True)
class Shot:
    """A ``camera`` at every ``step``-th frame from ``first`` to ``last``, or at the frames ``only``, which need not be
    whole numbers. Its files are named by ``given``, else after the .blend and the camera. ``motion``: whether the
    cameras one frame before and after each are needed, too. If markers switch the camera, ``cuts`` are the first frame
    and the name of each, in order: as in Blender, the first camera holds before its marker, too."""

    camera: bpy.types.Object
    first: int
    last: int
    step: int = 1
    given: str = ""
    only: tuple[float, ...] = ()
    motion: bool = False
    cuts: tuple[tuple[int, str], ...] = ()

    @property
    def camera_name(self) -> str:
        """The name that stands for the camera in names of files: the camera's, or CUTS if markers switch cameras."""
        return CUTS if self.cuts else self.camera.name

    def named(self, later: int = 0) -> str:
        """Return the shot's name. Its version, if it has one, is that of the .blend plus ``later``."""
        return shot_name(self.camera_name, self.given, later)

    def camera_at(self, frame: float) -> str:
        """Return the name of the camera that renders a frame."""
        return _camera_at_cut(self.cuts or ((0, self.camera.name),), frame)

    @property
    def frames(self) -> Sequence[float]:
        return self.only or range(self.first, self.last + 1, self.step)

    @property
    def warnings(self) -> list[str]:
        """Return warnings about what Blender would render but a bake leaves out, and about a shot's name without that
        of its file or camera."""
        scenes = self.camera.users_scene
        found = ["depth of field"] if self.camera.type == "CAMERA" and self.camera.data.dof.use_dof else []
        found += ["motion blur"] if any(scene.render.use_motion_blur for scene in scenes) else []
        warnings = [f"{what} of {self.camera.name} is not baked: the passes are sharp" for what in found]
        if any(scene.render.use_border and not scene.render.use_crop_to_border for scene in scenes):
            warnings.append("the render region is not cropped to, so whole pictures are baked")
        if self.cuts:
            cuts = ", ".join(f"{name} from {first}" for first, name in self.cuts)
            warnings.append(f"markers switch the camera ({cuts}): --camera with --range bakes one of these shots alone")
        words = bpy.path.display_name_from_filepath(bpy.data.filepath), self.camera_name
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
    """Return the shot of the named or the active camera over the given range, else the scene's. ``given`` names its
    files (else the studio does); ``only`` and ``motion``: see `Shot`. Raises PlgsError for a bad range and no
    camera."""
    cuts = () if camera else _cuts_of(scene)
    wanted = camera or (cuts[0][1] if cuts else "")
    ob = scene.objects.get(wanted) if wanted else scene.camera
    if ob is None or (camera and ob.type != "CAMERA"):
        what = f"has no camera named {camera!r}" if camera else "has no active camera"
        raise PlgsError("no-camera", what, scene.name, _cameras_to_choose(scene, camera))
    is_files = not only and (first is None or last is None)
    if is_files and scene.frame_end - scene.frame_start >= _MOST_OF_FILE:
        what = f"has a range of {scene.frame_end - scene.frame_start + 1} frames, too many to bake without --range"
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
        cuts if len({name for _, name in cuts}) > 1 else (),
    )
    if not shot.frames:
        what = f"cannot be baked: {shot.first} to {shot.last} is not a range of frames"
        fix = "Set the range in the Output properties: it must not end before it starts."
        raise PlgsError("bad-shot-range", what, scene.name, fix)
    return shot


def _camera_at_cut(cuts: Sequence[tuple[int, str]], frame: float) -> str:
    return ([name for first, name in cuts if first <= frame] or [cuts[0][1]])[-1]


def _cuts_of(scene: bpy.types.Scene) -> tuple[tuple[int, str], ...]:
    """Return the frames of the markers that switch the camera, each with the camera's name, in order. A lift's own
    markers do not count, as they only show its frames."""
    bound = [(marker.frame, marker.camera) for marker in scene.timeline_markers if marker.camera is not None]
    return tuple(sorted({frame: camera.name for frame, camera in bound if not is_of_lift(camera, scene)}.items()))


def _cameras_to_choose(scene: bpy.types.Scene, wanted: str) -> str:
    """Return advice, if no camera is called ``wanted`` ("": none is active): names of cameras, the likeliest first."""
    cameras = [ob for ob in scene.objects if ob.type == "CAMERA"]
    if not cameras:
        return "Add a camera, select it and press Ctrl+Numpad 0."
    similar = difflib.get_close_matches(wanted, [ob.name for ob in cameras])
    cameras.sort(key=lambda ob: (ob.name not in similar, "frame" in ob, ob.name))
    names = ", ".join(repr(ob.name) for ob in cameras[:_LISTED])
    more = f" and {len(cameras) - _LISTED} more" if len(cameras) > _LISTED else ""
    return f"Choose one of its cameras: {names}{more}."


def write_view(lift: Path, scene: bpy.types.Scene) -> Path:
    """Write the active camera's current view into the lift's folder, and return the file. Raises PlgsError without an
    active camera; OSError."""
    now = scene.frame_current
    ob = shot_of(scene, first=now, last=now, step=1).camera
    bpy.context.view_layer.update()  # a script may just have moved it
    name = numbered_name(safe_name(ob.name), now)
    write_cameras(lift / "bake" / f"{name}.json", [_camera_now(scene, ob, now, name)])
    return lift / "bake" / f"{name}.json"


def numbered_name(name: str, frame: float, digits: int = DIGITS) -> str:
    """Return a frame's file name, with at least ``digits`` digits, as Blender itself names renders: "shot.0003" and
    "shot.-0003". Half a frame later it is "shot.sub500.0003": programs count whole numbers only, so each fraction of a
    frame is a sequence of its own."""
    whole, part = divmod(round(1000 * frame), 1000)
    return f"{name}{f'.sub{part:03d}' if part else ''}.{'-' * (whole < 0)}{abs(whole):0{digits}d}"


class ShotReader:
    """Reads a shot's animated camera at each frame, as the scene renders it. It reads a few frames at a time, because
    Blender evaluates the scene at each frame, and a long range would freeze the window. Between two calls, the scene is
    at its original frame. Undo replaces the scene and the camera, so they are looked up by name."""

    def __init__(self, scene: bpy.types.Scene, shot: Shot) -> None:
        self._scene, self._frames = scene.name, shot.frames
        self._cuts = shot.cuts or ((0, shot.camera.name),)
        self._read: list[BakeCamera] = []
        self._others: list[int] = []
        self._checked = 0
        self._names = [shot.named(later) for later in range(_MOST_LATER if "{version" in shot.given else 1)]
        self._shot = self._names[0]
        self._first = math.floor(min(*shot.frames, scene.frame_start))
        self._last = math.ceil(max(*shot.frames, scene.frame_end))
        self._motion, self._beside = shot.motion, dict[tuple[str, float], BakeCamera]()
        self._digits = max(DIGITS, *(len(str(abs(frame))) for frame in (self._first, self._last)))
        self._source = ShotSource(bpy.data.filepath or bpy.app.tempdir, shot.camera_name)
        which = f"{shot.first}-{shot.last}x{shot.step}"
        if shot.only:  # two lists of frames may be baked at once
            which = f"{shot.only[0]}-{shot.only[-1]}.{zlib.crc32(repr(shot.only).encode()):08x}"
        self._which = which
        self._stands_still: bool | None = None
        self._claimed: Claim | None = None
        self.said: list[str] = []
        """What `write` has to tell: a name that became the next version, and what that lacks."""

    @property
    def progress(self) -> tuple[int, int]:
        """The numbers of frames read and of all to read, which for a camera at rest has frames outside the shot."""
        return len(self._read) + self._checked, len(self._frames) + len(self._others)

    @property
    def cameras(self) -> list[BakeCamera]:
        """Return the cameras read. If the camera stands still over the scene's whole range, it is one camera, named
        after the range's first frame, so that it has the same name in all parts of a shot."""
        return [replace(each, name=numbered_name(self._shot, frame, self._digits)) for frame, each in self._shown]

    @property
    def _shown(self) -> list[tuple[float, BakeCamera]]:
        """Return the frames to bake, each with its camera."""
        if self._stands_still:
            return [(self._first, replace(self._read[0], frame=self._first))]
        return list(zip(self._frames, self._read, strict=False))

    def read_for(self, seconds: float) -> bool:
        """Read at least a frame, for about ``seconds``. Returns whether all is read. Raises PlgsError for no camera."""
        end = time.monotonic() + seconds
        scene = bpy.data.scenes.get(self._scene)
        if scene is None:
            raise PlgsError("camera-gone", "was deleted meanwhile", self._scene, "Bake another.")
        with _frame_kept(scene):
            ob = self._camera(scene, self._first)
            if not self._read and len(self._cuts) == 1 and not _may_move(scene, ob):  # no need to evaluate each frame
                self._read, self._stands_still = [self._seen(scene, self._first)], True
            while self._stands_still is None and self._read_one(scene):
                if time.monotonic() >= end:
                    return False
        return True

    def _camera(self, scene: bpy.types.Scene, frame: float) -> bpy.types.Object:
        name = _camera_at_cut(self._cuts, frame)
        ob = scene.objects.get(name)
        if ob is None:
            raise PlgsError("camera-gone", "was deleted meanwhile", f"{self._scene}: {name}", "Bake another.")
        return ob

    def _seen(self, scene: bpy.types.Scene, frame: float) -> BakeCamera:
        return _camera_at(scene, self._camera(scene, frame), frame, "")

    def _read_one(self, scene: bpy.types.Scene) -> bool:
        """Read the camera at one more frame. Returns whether any frame is left."""
        if len(self._read) < len(self._frames):
            self._read.append(self._camera_with_motion(scene, self._frames[len(self._read)]))
            if len(self._read) < len(self._frames):
                return True
            is_short, taken = self._last - self._first < _MOST_OF_FILE, {*self._frames}
            if not is_short or len({each.fingerprint for each in self._read}) > 1:
                self._stands_still = False
                return False
            self._others = [each for each in range(self._first, self._last + 1) if each not in taken]
        else:
            seen = self._seen(scene, self._others[self._checked])
            self._checked += 1
            if seen.fingerprint != self._read[0].fingerprint:
                self._stands_still = False
                return False
        is_left = self._checked < len(self._others)
        self._stands_still = None if is_left else True
        return is_left

    def _camera_with_motion(self, scene: bpy.types.Scene, frame: float) -> BakeCamera:
        if not self._motion:
            return self._seen(scene, frame)
        ob = self._camera(scene, frame)  # also for the frames beside it: a cut is no motion
        around = [(ob.name, each) for each in (frame - 1, frame, frame + 1)]
        self._beside = {key: self._beside.get(key) or _camera_at(scene, ob, key[1], "") for key in around}
        previous, now, following = self._beside.values()
        return replace(now, previous=previous.pinhole, next=following.pinhole)

    def write(self, lift: Path, *, replace: bool = False, output: Path | None = None) -> Path:
        """Write the shot's cameras, once all frames are read, into the lift's folder or ``output``, and return the
        file. Raises PlgsError if another shot has the name; OSError."""
        blend = Path(self._source.blend)
        source = dataclasses.replace(
            self._source,
            blend=blend.name if blend.parent == lift else str(blend),  # relative, as the folder may be moved
            frames={numbered_name("", frame, 1)[1:]: camera.fingerprint for frame, camera in self._shown},
            fps=self._read[0].fps,
        ).of_lift(lift)
        folder, passes = (lift / "bake", lift / "result" / "passes") if output is None else (output / NOTES, output)
        earlier = ""
        for name in self._names:
            self._shot, file = name, folder / f"{name}.{self._which}.json"
            try:
                self._claimed = claim(folder, name, source, cameras=file, passes=passes, replaces=replace)
            except PlgsError as error:
                if error.key != "shot-changed" or name == self._names[-1]:
                    raise
                earlier = name
                continue
            self.said = next_version(folder, earlier, name) if earlier else []
            if self._claimed.left:
                self.said.append(f"frames of {name} still show its earlier state: {listed(self._claimed.left)}")
            break
        write_cameras(file, self.cameras)
        return file

    def withdraw_unbaked(self, bake: TaskFollower) -> None:
        """Take back what `write` wrote, if the bake ended before its first view, as when the engine refused it."""
        if self._claimed is not None and bake.state is not TaskState.FINISHED and bake.progress.stage != "bake":
            with suppress(OSError, PlgsError):  # then the name stays taken, and another bake reports that
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
    """Restore the current frame and its camera at the end of a ``with`` block."""
    frame, part, camera = scene.frame_current, scene.frame_subframe, scene.camera
    try:
        yield
    finally:
        scene.frame_set(frame, subframe=part)
        scene.camera = camera


def _check_lens(ob: bpy.types.Object, frame: float) -> None:
    """Raise PlgsError for a camera whose picture cannot be baked."""
    at = f"{ob.name}, frame {frame}"
    if ob.type != "CAMERA":
        raise PlgsError("not-a-camera", "is not a camera", at, "Make a camera the scene's active one.")
    if ob.data.type not in ("PERSP", "ORTHO"):
        limits = panorama_of(ob)
        kind = getattr(limits, "panorama_type", "unknown")
        if ob.data.type != "PANO" or kind != "EQUIRECTANGULAR":
            shown = f"panoramic ({kind.lower()})" if ob.data.type == "PANO" else ob.data.type.lower()
            what = f"is {shown}; only perspective, orthographic and equirectangular cameras can be baked"
            fix = "Set its type to Perspective or Orthographic, or to Panoramic with the type Equirectangular."
            raise PlgsError("other-lens", what, at, fix)
        if limits.longitude_min >= limits.longitude_max or limits.latitude_min >= limits.latitude_max:
            fix = "Set the minimum of its longitude and its latitude below the maximum."
            raise PlgsError("panorama-limits", "shows no part of the sphere, or mirrors it", at, fix)
    if ob.matrix_world.is_negative:
        raise PlgsError("mirrored", "shows the world mirrored", at, "Give it and its parents a positive scale.")


def _camera_at(scene: bpy.types.Scene, ob: bpy.types.Object, frame: float, name: str) -> BakeCamera:
    scene.frame_set(math.floor(frame), subframe=frame % 1)
    return _camera_now(scene, ob, frame, name)


def _camera_now(scene: bpy.types.Scene, ob: bpy.types.Object, frame: float, name: str) -> BakeCamera:
    _check_lens(ob, frame)
    camera, display = _rendered_part(seen_by(ob, scene.render), scene)
    if max(camera.width, camera.height) > LARGEST_SIDE:
        fix = f"Set its resolution to at most {LARGEST_SIDE} pixels per side."
        raise PlgsError("other-resolution", f"renders {camera.width}x{camera.height} pixels", scene.name, fix)
    near, far, fps = float(ob.data.clip_start), float(ob.data.clip_end), scene.render.fps / scene.render.fps_base
    pose, lens = (tuple(tuple(map(float, row)) for row in matrix) for matrix in (camera.camera_to_world, camera.K))
    pinhole = PreviewCamera(pose, lens, camera.width, camera.height, camera.projection)
    return BakeCamera(name, pinhole, near, far, math.floor(frame), fps, display)


def _rendered_part(camera: Camera, scene: bpy.types.Scene) -> tuple[Camera, tuple[int, int, int, int] | None]:
    """Return the camera of the baked picture: the render region if Blender crops to it, else the whole picture with
    EEVEE's overscan on all sides. Also return where the rendered picture lies in the baked one: left, top, width and
    height in pixels; None if it fills that. Raises PlgsError for an empty region."""
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
    elif scene.eevee.use_overscan and camera.projection != "equirectangular":
        more = math.ceil(max(width, height) * scene.eevee.overscan_size / 100)
        part, display = (-more, -more, width + more, height + more), (more, more, width, height)
    left, top, right, bottom = part
    middle = camera.cx - left, camera.cy - top
    return replace(camera, width=right - left, height=bottom - top, cx=middle[0], cy=middle[1]), display


def _pixels(share: float, size: int) -> int:
    """The pixels of a ``share`` of ``size`` pixels, as Blender counts a render border: as float32, truncated."""
    return int(np.float32(share) * np.float32(size))
