"""Baselines that need no lift: the input masks as they are, and votes in voxels, on the held-out frames of a scene."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np

from engine.batch.plan import state_of_files
from engine.job import LiftRequest, write_atomically
from engine.job.atomic import sha256
from engine.json_file import Json, read_object
from engine.metrics.report import INPUT_MASKS, PredictedView, Report, add_input_masks
from engine.scene import GroundTruth, open_asked
from engine.scene_source import SceneSource

from ..results import Figures, scores_by_method, this_engine
from .voxel_vote import VOXEL_VOTE, add_voxel_vote

VOXELS_ALONE = "voxel vote without objects"
WITHOUT_A_LIFT = (INPUT_MASKS, VOXEL_VOTE, VOXELS_ALONE)
FORMAT = 4


class _WithoutObjects(Report):
    """Scores each answer of the voxels a second time, with all objects of a class merged into one."""

    def add_labels(self, method: str, frame: str, view: PredictedView, truth: GroundTruth) -> None:
        super().add_labels(method, frame, view, truth)
        if method == VOXEL_VOTE:
            alone = PredictedView(view.semantic, np.zeros_like(view.instance))
            super().add_labels(VOXELS_ALONE, frame, alone, truth)


WITH_IDS = (VOXEL_VOTE,)
"""Methods whose ids mean the same in every frame, so that changes of them can be counted."""


def scores_without_a_lift(source: SceneSource, cache: Path) -> dict[str, Figures]:
    """Figures by method (WITHOUT_A_LIFT). Empty without ground truth. They are kept in ``cache``, and measured again if
    the engine, a file of the scene, or the format or classes of its masks have changed.

    Raises PlgsError when a file or the cache is bad.
    """
    scene, classes = open_asked(source), source.classes
    made_of: dict[str, Json] = {
        "format": FORMAT,
        "engine_version": this_engine(),
        "scene_format": scene.format,
        "files": state_of_files(LiftRequest(**vars(source)), cache.parent),
        "mask_format": source.mask_format,
        "classes": sha256(Path(classes)) if classes and classes.endswith(".toml") else classes,
    }
    content = read_object(cache, "Delete it: the same command then makes it again.") if cache.is_file() else {}
    if any(content.get(key) != value for key, value in made_of.items()):
        began, report = time.monotonic(), _WithoutObjects(scene.classes)
        add_input_masks(report, scene)
        add_voxel_vote(report, scene)
        content = {**report.to_json(), **made_of}  # type: ignore[dict-item]
        content["seconds"] = round(time.monotonic() - began, 1)
        cache.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(cache, json.dumps(content, indent=1) + "\n")
    tables = content.get("tables")
    found = scores_by_method([each for each in tables if isinstance(each, dict)] if isinstance(tables, list) else [])
    return {name: each if name in WITH_IDS else each._replace(id_changes=None) for name, each in found.items()}
