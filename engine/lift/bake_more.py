"""Passes of more views of a finished lift: of its frames, bit for bit as a lift that bakes them writes them, and of any
camera. Several processes may bake one lift at once; each view is baked by one of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ..corrections import read_corrected
from ..errors import PlgsError
from ..job import (
    BakeCamera,
    BakeLocks,
    EventWriter,
    LiftFolder,
    StopSignal,
    add_files,
    drop_files,
    read_cameras,
    read_manifest,
)
from ..job.cameras import refuse_equal_names
from ..model.rendering import ClipRange
from ..passes.exr import read_note
from ..scene import Camera, Frame, Scene, open_asked
from ..train.progress import StageReporter
from .baking import CORRECTIONS_NOTE, baked_files, read_baker

STAGES = {"open": "Opening the lifted scene", "bake": "Baking panoptic passes"}
KEEP_EVERY_S = 20.0
"""Seconds between two times that baked views are taken into the manifest: the most work that a kill loses."""
CAMERA_NOTE = "plgs/camera"
"""Attribute in the header of a view that is no frame's: the fingerprint of its camera."""


@dataclass(frozen=True, eq=False)
class WantedView:
    """A view to bake. ``fingerprint`` is that of a camera that is no frame's, and empty for a frame."""

    name: str
    camera: Camera
    clip: ClipRange = ClipRange()
    fingerprint: str = ""


def bake_frames(folder: LiftFolder, frames: Sequence[str], events: EventWriter, stop: StopSignal) -> None:
    """Bake frames that are not baked yet: "test", "all", or names. The result is whole at every moment.

    Raises PlgsError when the scene cannot be read any more, or does not have a frame; Cancelled when stopped. What was
    baked until then stays.
    """
    with BakeLocks(folder.path) as locks:
        _bake(folder, locks, lambda scene: _views_of(frames_named(scene, frames)), events, stop)


def bake_cameras(folder: LiftFolder, cameras: Path, events: EventWriter, stop: StopSignal) -> None:
    """Bake the views of a file of cameras (see `job.cameras`) that are not baked yet, as `bake_frames` does. A view
    that was baked from another camera of the same name is baked anew.

    Raises PlgsError for a bad camera, and for one with the name of a frame; otherwise as `bake_frames`.
    """

    def views_in(scene: Scene) -> list[WantedView]:
        wanted = read_cameras(cameras)
        refuse_equal_names([camera.name for camera in wanted], cameras, [frame.name for frame in scene.frames])
        return [view_from(camera) for camera in wanted]

    with BakeLocks(folder.path) as locks:
        _bake(folder, locks, views_in, events, stop)


def view_from(camera: BakeCamera) -> WantedView:
    """The view of a camera, as the engine renders it."""
    pinhole = camera.pinhole
    (fx, _, cx), (_, fy, cy), _ = pinhole.K
    seen = Camera(pinhole.width, pinhole.height, fx, fy, cx, cy, np.array(pinhole.camera_to_world))
    return WantedView(camera.name, seen, ClipRange(camera.near, camera.far), camera.fingerprint)


def _views_of(frames: Sequence[Frame]) -> list[WantedView]:
    return [WantedView(frame.name, frame.camera) for frame in frames]


def _bake(
    folder: LiftFolder,
    locks: BakeLocks,
    views_in: Callable[[Scene], list[WantedView]],
    events: EventWriter,
    stop: StopSignal,
) -> None:
    torch.use_deterministic_algorithms(True)
    stages = StageReporter(events, stop, STAGES)
    with stages.stage("open"):
        scene = open_asked(folder.request)
        corrections = read_corrected(folder.path).fingerprint
        wanted = [view for view in views_in(scene) if not is_baked(folder, view, corrections)]
        baker = read_baker(folder, scene.classes)
    new = _NewViews(folder, locks)
    with stages.stage("bake") as progress:
        try:
            for done, view in enumerate(wanted, start=1):
                with locks.claim(view.name) as is_ours:
                    if is_ours and not is_baked(folder, view, baker.corrections):
                        new.make_room(view)
                        notes = {CAMERA_NOTE: view.fingerprint} if view.fingerprint else {}
                        baker.write(folder, view.name, baker.render(view.camera, view.clip), events, notes)
                        new.add(view, at_once=locks.others_at_work())
                progress(done, len(wanted))
        finally:
            new.keep()


def is_baked(folder: LiftFolder, view: WantedView, corrections: str) -> bool:
    """Whether the result has this view, from this camera and with these corrections. Raises PlgsError, OSError."""
    files = baked_files(folder, view.name)
    listed = {folder.result_path / file.path for file in read_manifest(folder.result_path).files}
    if not listed.issuperset(files):
        return False
    try:
        same_camera = not view.fingerprint or read_note(files[0], CAMERA_NOTE) == view.fingerprint
        return same_camera and (read_note(files[0], CORRECTIONS_NOTE) or "") == corrections
    except ValueError:  # damaged: it is baked anew
        return False


def frames_named(scene: Scene, names: Sequence[str]) -> list[Frame]:
    """In recording order, each once. Raises PlgsError for a name that no frame has."""
    known = {frame.name: frame for frame in scene.frames}
    groups = {"all": scene.frames, "test": scene.test_frames}
    unknown = [name for name in names if name not in known and name not in groups]
    if unknown:
        fix = f"Give all, test, or names of frames, such as {scene.frames[0].name}."
        raise PlgsError(f"the scene has no frame {unknown[0]}", scene.folder, fix)
    wanted = {frame.name for name in names for frame in ((known[name],) if name in known else groups[name])}
    return [frame for frame in scene.frames if frame.name in wanted]


class _NewViews:
    """Takes baked views into the manifest, every KEEP_EVERY_S seconds."""

    def __init__(self, folder: LiftFolder, locks: BakeLocks) -> None:
        self._folder, self._locks = folder, locks
        self._views, self._kept_at = list[WantedView](), time.monotonic()

    def make_room(self, view: WantedView) -> None:
        """Take a view that is baked anew out of the manifest, so that the result is whole without it. Raises
        OSError."""
        listed = {self._folder.result_path / file.path for file in read_manifest(self._folder.result_path).files}
        old = listed.intersection(baked_files(self._folder, view.name))
        if old:
            with self._locks.manifest():
                drop_files(self._folder.result_path, sorted(old))

    def add(self, view: WantedView, *, at_once: bool) -> None:
        """``at_once``: keep the view before another process looks for views that are left to bake."""
        self._views.append(view)
        if at_once or time.monotonic() - self._kept_at > KEEP_EVERY_S:
            self.keep()

    def keep(self) -> None:
        """Take the new views into the manifest. Raises OSError."""
        files = [path for view in self._views for path in baked_files(self._folder, view.name)]
        if files:
            with self._locks.manifest():
                add_files(self._folder.result_path, files)
        self._views, self._kept_at = [], time.monotonic()
