"""Score baselines without a lift, on the held-out frames of a scene: the input masks, and votes in voxels."""

from __future__ import annotations

import numpy as np

from engine.metrics.report import INPUT_MASKS, PredictedView, Report, add_input_masks
from engine.scene import GroundTruth, open_asked
from engine.scene_source import SceneSource

from ..results import Figures, scores_by_method
from .voxel_vote import VOXEL_VOTE, add_voxel_vote

VOXELS_ALONE = "voxel vote without objects"
WITHOUT_A_LIFT = (INPUT_MASKS, VOXEL_VOTE, VOXELS_ALONE)


class _WithoutObjects(Report):
    """A report that also scores each answer of the voxels with all objects of a class merged into one."""

    def add_labels(self, method: str, frame: str, view: PredictedView, truth: GroundTruth) -> None:
        super().add_labels(method, frame, view, truth)
        if method == VOXEL_VOTE:
            alone = PredictedView(view.semantic, np.zeros_like(view.instance))
            super().add_labels(VOXELS_ALONE, frame, alone, truth)


WITH_IDS = (VOXEL_VOTE,)
"""Methods whose ids mean the same in every frame, so that changes of them can be counted."""


def scores_without_a_lift(source: SceneSource) -> dict[str, Figures]:
    """Return figures by method (WITHOUT_A_LIFT); {} without ground truth. Raises PlgsError if a file is bad."""
    scene = open_asked(source)
    report = _WithoutObjects(scene.classes)
    add_input_masks(report, scene)
    add_voxel_vote(report, scene)
    tables = report.to_json()["tables"]
    found = scores_by_method([each for each in tables if isinstance(each, dict)] if isinstance(tables, list) else [])
    return {name: each if name in WITH_IDS else each._replace(id_changes=None) for name, each in found.items()}
