"""The source of an export: a finished lift, its labels, and its views, which are rendered if they are not baked."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..corrections import CorrectedResult, read_corrected
from ..errors import PlgsError, did_you_mean
from ..job import LiftFolder, read_cameras, read_manifest, verify_files
from ..job.manifest import damaged
from ..job.progress import Progress, part_of, unwatched
from ..lift.bake_more import WantedView, frames_named, view_from
from ..lift.baking import CORRECTIONS_NOTE, FrameBaker, baked_files, names_of_files, read_baker
from ..passes.baked_view import ShownInstances
from ..passes.exr import read_exr, read_note
from ..passes.layers import PanopticLayers
from ..posed.layout import listed
from ..posed.ply import read_gaussians
from ..result_files import Instance
from ..scene import Camera, ClassTable, Frame, Scene, evenly_spread
from ..scene_of_lift import scene_of_lift


@dataclass(frozen=True, eq=False)
class FinishedLift:
    """A finished lift, and the ``names`` of frames to export. The first use of an attribute may raise PlgsError."""

    folder: LiftFolder
    names: Sequence[str]
    progress: Progress = unwatched
    cameras: Path | None = None
    """A file of cameras to export instead of the frames."""
    objects: Sequence[str] = ()
    """The names of the instances and classes to export; empty for all."""
    warn: Callable[[str], object] | None = None

    @cached_property
    def scene(self) -> Scene:
        return scene_of_lift(self.folder)

    @cached_property
    def has_photos(self) -> bool:
        """Whether the scene is available. Without it, a surface shows the lift's colours, and a warning says so."""
        found = os.path.exists(self.folder.request.scene)
        if not found and self.warn is not None:
            self.warn(f"The mesh has no textures, as its scene is not at {self.folder.request.scene}.")
        return found

    @property
    def classes(self) -> ClassTable:
        return self.scene.classes

    @cached_property
    def frames(self) -> list[Frame]:
        """The frames to export, in recording order."""
        return frames_named(self.scene, self.names)

    @cached_property
    def instances(self) -> ShownInstances:
        return self._baker.instances

    @cached_property
    def listed(self) -> tuple[Instance, ...]:
        """The instances to export, after corrections."""
        return tuple(each for each in self.corrected.instances if self.wants(each.class_id, each.id))

    @cached_property
    def _wanted(self) -> tuple[frozenset[int], frozenset[int]]:
        """The ids of classes and of instances that the user named. Raises PlgsError for an unknown name."""
        of_class = {each.id: each.name.casefold() for each in self.classes.categories}
        of_instance = {number: name.casefold() for number, name in self.instances.names.items()}
        unknown = [name for name in self.objects if name.casefold() not in {*of_class.values(), *of_instance.values()}]
        if unknown:
            names = [*self.instances.names.values(), *of_class.values()]
            fix = f"{did_you_mean(unknown[0], names)}Name objects or classes, such as {listed(names)}."
            what = f'the lift has nothing called "{unknown[0]}"'
            raise PlgsError("no-such-name", what, self.folder.path, fix, option="--objects")
        asked = {name.casefold() for name in self.objects}
        return (
            frozenset(number for number, name in of_class.items() if name in asked),
            frozenset(number for number, name in of_instance.items() if name in asked),
        )

    def wants(self, class_id: int, instance_id: int) -> bool:
        """Whether an instance, or stuff (``instance_id`` 0), is exported."""
        return not self.objects or class_id in self._wanted[0] or instance_id in self._wanted[1]

    @cached_property
    def splats(self) -> NDArray[np.void]:
        """The Gaussians to export as rows of gaussians.ply, [N], with their corrected labels."""
        rows = self.corrected.splats(read_gaussians(self.folder.result_path / "gaussians.ply"))
        if not self.objects:
            return rows
        classes, instances = (np.array(sorted(ids)) for ids in self._wanted)
        return rows[np.isin(rows["class_id"], classes) | np.isin(rows["instance_id"], instances)]

    @cached_property
    def corrected(self) -> CorrectedResult:
        corrected = read_corrected(self.folder.path)
        if self.warn is not None:
            for line in corrected.warnings:
                self.warn(line)
        return corrected

    @cached_property
    def _baker(self) -> FrameBaker:
        return read_baker(self.folder, self.classes, self.corrected)

    @cached_property
    def shots(self) -> list[WantedView]:
        """The views of the cameras in the file that the user gave; none without one."""
        return [] if self.cameras is None else [view_from(camera) for camera in read_cameras(self.cameras)]

    def shown(self, *wanted: str) -> Iterator[tuple[str, Camera, PanopticLayers]]:
        """Yield name, camera and layers of each view: those of the cameras in the file, else of the frames. ``wanted``
        names the layers (none: all)."""
        if self.cameras is None:
            yield from ((frame.name, frame.camera, layers) for frame, layers in self.views(*wanted))
        for number, view in enumerate(self.shots, start=1):
            yield view.name, view.camera, self._baker.layers(view.camera, view.clip, wanted)
            self.progress(number, len(self.shots))

    def views(self, *wanted: str) -> Iterator[tuple[Frame, PanopticLayers]]:
        """Yield every frame with its layers in the lift, at the frame's size. ``wanted`` names layers (none: all)."""
        result = self.folder.result_path
        listed = {result / file.path: file for file in read_manifest(result).files}
        names = names_of_files(self.folder)
        for number, frame in enumerate(self.frames, start=1):
            baked = baked_files(self.folder, names.get(frame.name, frame.name))[0]
            if baked in listed and is_corrected(baked, self.corrected.fingerprint):
                verify_files(result, [listed[baked]])
                try:
                    layers = read_exr(baked)
                except ValueError as error:
                    raise damaged("frame-unreadable", "a baked frame cannot be read", baked) from error
            else:
                layers = self._baker.layers(frame.camera, wanted=wanted)
            yield frame, layers
            self.progress(number, len(self.frames))

    def part(self, begin: float, end: float) -> Progress:
        """Return a progress callback, in percent, for the part of the export between two shares (0..1) of it."""
        return part_of(self.progress, begin, end, 100)

    def small_views(self, width: int, most: int, progress: Progress) -> Iterator[tuple[Frame, Camera, PanopticLayers]]:
        """Yield at most ``most`` frames, evenly spread, with camera and layers, drawn at most ``width`` pixels wide."""
        chosen = evenly_spread(self.frames, most)
        for number, frame in enumerate(chosen, start=1):
            shrunk = min(1.0, width / frame.camera.width)
            camera = frame.camera.resized(*(round(shrunk * side) for side in (frame.camera.width, frame.camera.height)))
            yield frame, camera, self._baker.decided(camera, wanted=("combined", "depth", "semantic", "instance"))
            progress(number, len(chosen))


def is_corrected(baked: Path, corrections: str) -> bool:
    """Whether the passes ``baked`` show the ``corrections``, a fingerprint. True for damaged passes: readers tell."""
    try:
        return (read_note(baked, CORRECTIONS_NOTE) or "") == corrections
    except ValueError:
        return True
