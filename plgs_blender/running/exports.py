"""Exports of finished lifts, and the meshes among them that are put into the scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy

from ...engine.errors import PlgsError
from ...engine.job.follower import TaskFollower
from ..lift_scene import place_meshes_anew
from ..tasks import registry, timer
from ..tasks.registry import Task, start_engine

FORMS = {
    "coco": ("COCO panoptic", "panoptic.json and PNGs of segments"),
    "instances": ("Label images", "16-bit PNGs of classes and instances, and in colours"),
    "scannet": ("ScanNet labels", "label-filt, instance-filt and their table"),
    "points": ("Labelled points", "PLY of the semantic points, and of the Gaussians"),
    "boxes": ("Boxes", "The objects' oriented boxes as JSON and CSV"),
    "mesh": ("Meshes", "The surface as PLY, and a GLB for each instance and each stuff class"),
    "depth": ("Depth maps", "The lifted surface's depth as 16-bit PNGs in millimetres"),
}
"""Label and description of each form that the engine exports to."""


class Export(Task):
    """One export. What was written stays when it is cancelled. ``mesh_scene`` names the scene that its meshes are put
    into."""

    kind, label, cancel_operator = "export", "Exporting", "plgs.cancel_export"

    def __init__(self, lift: Path, form: str, output: Path, mesh_scene: str, follower: TaskFollower) -> None:
        super().__init__(follower)
        self.form, self.output = form, output
        self.label = f"Exporting {FORMS[form][0]}"
        self._lift, self._mesh_scene = lift, mesh_scene
        self._meshes = 0

    @property
    def message(self) -> str:
        """One line about how it ended well, or was cancelled."""
        if self.was_cancelled:
            return "The export was cancelled"
        if self._mesh_scene:
            return f"{self._meshes} meshes are in the scene"
        return f"{FORMS[self.form][0]} are in {self.output}"

    def done(self, scene: Any) -> None:
        if not self.has_finished or not self._mesh_scene:
            return
        target = bpy.data.scenes.get(self._mesh_scene)
        if target is None:
            raise PlgsError("the scene is gone", self._mesh_scene, "Make the meshes again.")
        self._meshes = len(place_meshes_anew(self._lift, target))
        self.undo_step = "Make Meshes"


def export(
    lift: Path, form: str, output: Path, python: Path, frames: Sequence[str] = ("all",), *, mesh_scene: str = ""
) -> Export:
    """Start an export of a finished lift into the folder ``output``. Raises PlgsError, OSError."""
    registry.refuse_second(Export)
    arguments: list[str | Path] = [lift, "--to", form, "-o", output, "--frames", *frames]
    return timer.begin(Export(lift, form, output, mesh_scene, start_engine("export", python, *arguments)))
