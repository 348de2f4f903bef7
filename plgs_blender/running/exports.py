"""Exports of finished lifts, also of meshes and clouds for the scene."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import bpy

from ...engine.errors import PlgsError
from ...engine.job.follower import TaskFollower
from .. import engine_environment, registry
from ..errors import plural
from ..lift_scene import place_depth_clouds_anew, placing_meshes_anew
from ..meshes import SURFACE, mesh_folder
from ..owned import root_of_placed
from ..registry import Task, start_engine

FORMS = {
    "gltf": ("glTF, Finer", "The meshes of all instances and stuff classes in one GLB, made anew and finer"),
    "usd": ("OpenUSD, Finer", "Gaussians, finer meshes, boxes and cameras in one USD file"),
    "splats": ("Splats", "PLY, SPZ and GLB of the Gaussians alone, with the names of their ids"),
    "mesh": ("Meshes, Finer", "The surface as PLY, and a GLB for each instance and each stuff class"),
    "surface": ("Surface", "The surface as one PLY with pictures, as Blender shows it"),
    "points": ("Labelled Points", "PLY of the semantic points, and of the Gaussians"),
    "boxes": ("Boxes", "The objects' oriented boxes as JSON and CSV"),
    "depth": ("Depth Maps", "The lifted surface's depth in metres, one NPY per frame"),
    "clouds": ("Depth Clouds", "Each frame's pixels as labelled points in the world, one NPZ per frame"),
    "coco": ("COCO Panoptic", "panoptic.json and PNGs of segments"),
    "instances": ("Label Images", "16-bit PNGs of classes and instances, and coloured PNGs"),
    "scannet": ("ScanNet Labels", "label-filt, instance-filt and their table"),
}
"""Label and description of each export format, an artist's first."""
OF_FRAMES = ("depth", "clouds", "coco", "instances", "scannet")
"""Formats that are files of each frame, so that a choice of frames means something."""


class Export(Task):
    """An export in progress. Files written before a cancel stay. ``shown_in`` names the scene for its meshes or clouds.
    If no user ``asked`` for it, it does not change what is shown, and an export by the user ends it."""

    kind, label, cancel_operator = "export", "Exporting", "plgs.cancel_export"

    def __init__(
        self, lift: Path, form: str, output: Path, shown_in: str, follower: TaskFollower, *, asked: bool = True
    ) -> None:
        super().__init__(follower)
        self.asked = asked
        self.form, self.output = form, output
        self.label = f"Exporting {FORMS[form][0]}"
        self._lift, self._shown_in = lift, shown_in
        self._placed = 0

    @property
    def is_for_scene(self) -> bool:
        """Whether the export's meshes or clouds go into a scene."""
        return bool(self._shown_in)

    @property
    def makes_meshes(self) -> bool:
        """Whether the export makes the surface that a scene shows."""
        return self.is_for_scene and self.form == SURFACE

    @property
    def message(self) -> str:
        """One line for the user about the export's success or cancellation."""
        if self.was_cancelled:
            return "The export was cancelled"
        if self._shown_in:
            words = ("mesh is", "meshes are") if self.form == SURFACE else ("point is", "points are")
            return f"{plural(self._placed, *words)} in the scene"
        return f"{FORMS[self.form][0]}: written to {self.output}"

    def done(self, scene: Any) -> Iterator[None]:
        if not self.has_finished or not self._shown_in:
            return
        target = bpy.data.scenes.get(self._shown_in)
        if target is None:
            what = "this Blender scene was deleted meanwhile"
            raise PlgsError("scene-gone", what, self._shown_in, "Press the button again in another scene.")
        if self.form == SURFACE:
            self._placed = yield from placing_meshes_anew(self._lift, target, asked=self.asked)
            self.undo_step = "Make Meshes"
        else:
            self._placed, self.undo_step = place_depth_clouds_anew(self._lift, target), "Depth Cloud"


def export(
    lift: Path,
    form: str,
    output: Path,
    python: Path,
    frames: Sequence[str] = ("all",),
    *,
    cameras: Path | None = None,
    shown_in: str = "",
    asked: bool = True,
) -> Export:
    """Start an export of a finished lift into the folder ``output``, of ``frames`` or of a file of ``cameras``.
    ``shown_in`` and ``asked`` are as in `Export`. Raises PlgsError if an export is running; OSError."""
    if not asked or is_busy():
        registry.refuse_second(Export)
    registry.forget(Export.kind)
    seen = ["--frames", *frames] if cameras is None else ["--cameras", cameras]
    arguments: list[str | Path] = [lift, "--to", form, "-o", output, *seen]
    follower = start_engine("export", python, *arguments)
    return registry.begin(Export(lift, form, output, shown_in, follower, asked=asked))


def make_meshes(lift: Path, scene: bpy.types.Scene, frames: str = "all", *, asked: bool = True) -> Export:
    """Let an engine make the meshes of a lift that is in the scene, and add them. ``frames`` and ``asked`` are as in
    `export`. Raises PlgsError without an engine; OSError."""
    root_of_placed(lift, scene)  # raises an error now, not when the meshes are made
    python = engine_environment.usable_python()
    return export(lift, SURFACE, mesh_folder(lift), python, [frames], shown_in=scene.name, asked=asked)


def beside(lift: Path) -> Path:
    """Return where to propose a lift's exports: at a path of its name beside it, or at home if that is read-only."""
    return lift if os.access(lift.parent, os.W_OK) else Path.home() / lift.name


def is_busy() -> bool:
    """Whether an export that a user asked for is running."""
    return any(task.asked for task in registry.running(Export))


def can_make_meshes_unasked() -> bool:
    """Whether meshes may be made unasked: there is a window to show them, an engine, and no other export."""
    return not bpy.app.background and engine_environment.why_no_engine() is None and not registry.running(Export)


def making_meshes() -> Export | None:
    """Return the running export whose meshes go into a scene, None if none runs."""
    return next((task for task in registry.running(Export) if task.makes_meshes), None)
