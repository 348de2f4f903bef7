"""What is exported: a finished lift, its labels, and its views, rendered where they are not baked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ..job import JobError, LiftFolder, read_manifest, verify_files
from ..job.manifest import MAKE_ANEW
from ..lift.bake_more import frames_named
from ..lift.baking import FrameBaker, baked_files, read_baker
from ..lift.scene_files import read_instances
from ..passes import PanopticLayers, ShownInstances, read_exr
from ..scene import ClassTable, Frame, Scene, open_asked


@dataclass(frozen=True, eq=False)
class FinishedLift:
    """A lift and the frames of it to export. Reads what it is asked for; raises SceneError, JobError, OSError then."""

    folder: LiftFolder
    names: Sequence[str]
    count_frames: bool = False

    @cached_property
    def scene(self) -> Scene:
        request = self.folder.request
        return open_asked(request)

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
    def records(self) -> list[dict[str, Any]]:
        """The instances as instances.json lists them."""
        return read_instances(self.folder)

    @cached_property
    def _baker(self) -> FrameBaker:
        return read_baker(self.folder, self.classes)

    def views(self) -> Iterator[tuple[Frame, PanopticLayers]]:
        """Every frame as the lift shows it, at the frame's own size."""
        result = self.folder.result_path
        listed = {result / file.path: file for file in read_manifest(result).files}
        for frame in self.frames:
            baked = baked_files(self.folder, frame.name)[0]
            if baked in listed:
                verify_files(result, [listed[baked]])
                yield frame, _read(baked)
            else:
                yield frame, self._baker.render(frame.camera).layers


def _read(baked: Path) -> PanopticLayers:
    """Raises JobError for a file that is damaged, OSError."""
    try:
        return read_exr(baked)
    except ValueError as error:
        raise JobError("a baked frame cannot be read", baked, MAKE_ANEW) from error
