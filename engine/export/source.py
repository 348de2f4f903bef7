"""What is exported: a finished lift, its labels, and its views, rendered where they are not baked."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ..corrections import CorrectedResult, read_corrected
from ..job import LiftFolder, read_cameras, read_manifest, verify_files
from ..job.manifest import damaged
from ..lift.bake_more import WantedView, frames_named, view_from
from ..lift.baking import CORRECTIONS_NOTE, FrameBaker, baked_files, names_of_files, read_baker
from ..passes.baked_view import ShownInstances
from ..passes.exr import read_exr, read_note
from ..passes.layers import PanopticLayers
from ..result_files import Instance
from ..scene import Camera, ClassTable, Frame, Scene
from ..scene_of_lift import scene_of_lift

Progress = Callable[[int, int], object]
"""Called after each view with the number of views done and of all. An error that it raises ends the work."""


@dataclass(frozen=True, eq=False)
class FinishedLift:
    """A lift and the frames of it to export. Each attribute is read when it is first used, and then raises PlgsError or
    OSError."""

    folder: LiftFolder
    names: Sequence[str]
    progress: Progress | None = None
    cameras: Path | None = None
    """A file of cameras to export in place of the frames."""

    @cached_property
    def scene(self) -> Scene:
        return scene_of_lift(self.folder)

    @property
    def classes(self) -> ClassTable:
        return self.scene.classes

    @cached_property
    def frames(self) -> list[Frame]:
        """In recording order."""
        return frames_named(self.scene, self.names)

    @cached_property
    def instances(self) -> ShownInstances:
        return self._baker.instances

    @cached_property
    def listed(self) -> tuple[Instance, ...]:
        """The instances as they are corrected."""
        return self.corrected.instances

    @cached_property
    def corrected(self) -> CorrectedResult:
        return read_corrected(self.folder.path)

    @cached_property
    def _baker(self) -> FrameBaker:
        return read_baker(self.folder, self.classes, self.corrected)

    @cached_property
    def shots(self) -> list[WantedView]:
        """The cameras of the file, or none."""
        return [] if self.cameras is None else [view_from(camera) for camera in read_cameras(self.cameras)]

    def shown(self) -> Iterator[tuple[str, Camera, PanopticLayers]]:
        """What the cameras see, each with its name; without a file of them, what the frames see."""
        if self.cameras is None:
            yield from ((frame.name, frame.camera, layers) for frame, layers in self.views())
        for number, view in enumerate(self.shots, start=1):
            yield view.name, view.camera, self._baker.render(view.camera, view.clip).layers
            if self.progress is not None:
                self.progress(number, len(self.shots))

    def views(self) -> Iterator[tuple[Frame, PanopticLayers]]:
        """Every frame as the lift shows it, at the frame's own size. Progress is reported after each."""
        result = self.folder.result_path
        listed = {result / file.path: file for file in read_manifest(result).files}
        names = names_of_files(self.folder)
        for number, frame in enumerate(self.frames, start=1):
            baked = baked_files(self.folder, names.get(frame.name, frame.name))[0]
            if baked in listed and is_corrected(baked, self.corrected.fingerprint):
                verify_files(result, [listed[baked]])
                yield frame, _read(baked)
            else:
                yield frame, self._baker.render(frame.camera).layers
            if self.progress is not None:
                self.progress(number, len(self.frames))


def is_corrected(baked: Path, corrections: str) -> bool:
    """Whether baked passes show these corrections. A damaged file is left to its reader."""
    try:
        return (read_note(baked, CORRECTIONS_NOTE) or "") == corrections
    except ValueError:
        return True


def _read(baked: Path) -> PanopticLayers:
    """Raises PlgsError for a file that is damaged, OSError."""
    try:
        return read_exr(baked)
    except ValueError as error:
        raise damaged("a baked frame cannot be read", baked) from error
