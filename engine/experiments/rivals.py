"""What needs no lift: the machine's masks as they are, and votes in voxels, on the held-out frames of a scene."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np

from .. import __version__
from ..job import write_atomically
from ..job.json_file import read_object
from ..metrics import MACHINE_MASKS, VOXEL_VOTE, PredictedView, Report, add_rivals
from ..scene import GroundTruth, Scene
from .figures import Figures, scores_by_method

VOXELS_ALONE = "voxel vote without objects"
RIVALS = (MACHINE_MASKS, VOXEL_VOTE, VOXELS_ALONE)
FORMAT = 1


class _WithoutObjects(Report):
    """Scores each answer of the voxels a second time, with no object told from another of its class."""

    def add_labels(self, method: str, frame: str, view: PredictedView, truth: GroundTruth) -> None:
        super().add_labels(method, frame, view, truth)
        if method == VOXEL_VOTE:
            alone = PredictedView(view.semantic, np.zeros_like(view.instance))
            super().add_labels(VOXELS_ALONE, frame, alone, truth)


def scores_of_rivals(scene: Scene, cache: Path) -> dict[str, Figures]:
    """Figures by method (RIVALS), measured once for a scene and kept in ``cache``. Empty without ground truth.

    Raises SceneError when a file is bad, JobError when the cache is.
    """
    if cache.is_file():
        content = read_object(cache, "Delete it: the same command then makes it anew.")
    else:
        began, report = time.monotonic(), _WithoutObjects(scene.classes)
        add_rivals(report, scene)
        content = {"format": FORMAT, "engine_version": __version__, **report.to_json()}  # type: ignore[dict-item]
        content["seconds"] = round(time.monotonic() - began, 1)
        cache.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(cache, json.dumps(content, indent=1) + "\n")
    tables = content.get("tables")
    return scores_by_method([each for each in tables if isinstance(each, dict)] if isinstance(tables, list) else [])
