"""Passes of more frames of a finished lift: what a lift that bakes them writes, bit for bit."""

from __future__ import annotations

import time
from collections.abc import Sequence

import torch

from ..job import EventWriter, JobError, LiftFolder, StopSignal, add_files, read_manifest
from ..scene import Frame, Scene, open_scene
from ..train.progress import StageReporter
from .baking import FrameBaker, baked_files
from .scene_files import read_model, read_shown_instances

STAGES = {"open": "Opening the lifted scene", "bake": "Baking panoptic passes"}
KEEP_EVERY_S = 20.0
"""A kill loses at most this much work: so often what was baked is taken into the manifest."""


def bake_frames(folder: LiftFolder, frames: Sequence[str], events: EventWriter, stop: StopSignal) -> None:
    """Bake frames that are not baked yet: "test", "all", or names. The result is whole all the while.

    Raises SceneError when the scene cannot be read any more, JobError for a frame that it does not have, Cancelled when
    stopped; what was baked until then stays.
    """
    torch.use_deterministic_algorithms(True)
    stages = StageReporter(events, stop, STAGES)
    with stages.stage("open"):
        scene = open_scene(folder.request.scene, folder.request.masks, folder.request.up)
        listed = {folder.result_path / file.path for file in read_manifest(folder.result_path).files}
        named = frames_named(scene, frames)
        wanted = [frame for frame in named if not listed.issuperset(baked_files(folder, frame.name))]
        baker = FrameBaker(scene.classes, read_model(folder), read_shown_instances(folder))
    new = _NewFrames(folder)
    with stages.stage("bake") as progress:
        try:
            for done, frame in enumerate(wanted, start=1):
                baker.write(folder, frame.name, baker.render(frame.camera), events)
                new.add(frame)
                progress(done, len(wanted))
        finally:
            new.keep()


def frames_named(scene: Scene, names: Sequence[str]) -> list[Frame]:
    """In recording order, each once. Raises JobError for a name that no frame has."""
    known = {frame.name: frame for frame in scene.frames}
    groups = {"all": scene.frames, "test": scene.test_frames}
    unknown = [name for name in names if name not in known and name not in groups]
    if unknown:
        fix = f"Give all, test, or names of frames, such as {scene.frames[0].name}."
        raise JobError(f"the scene has no frame {unknown[0]}", scene.folder, fix)
    wanted = {frame.name for name in names for frame in ((known[name],) if name in known else groups[name])}
    return [frame for frame in scene.frames if frame.name in wanted]


class _NewFrames:
    """Takes what was baked into the manifest, now and then."""

    def __init__(self, folder: LiftFolder) -> None:
        self._folder, self._frames, self._kept_at = folder, list[Frame](), time.monotonic()

    def add(self, frame: Frame) -> None:
        self._frames.append(frame)
        if time.monotonic() - self._kept_at > KEEP_EVERY_S:
            self.keep()

    def keep(self) -> None:
        """Raises OSError."""
        files = [path for frame in self._frames for path in baked_files(self._folder, frame.name)]
        if files:
            add_files(self._folder.result_path, files)
        self._frames, self._kept_at = [], time.monotonic()
