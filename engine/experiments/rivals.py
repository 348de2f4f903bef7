"""What needs no lift: the machine's masks as they are, and votes in voxels, on the held-out frames of a scene."""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path

import numpy as np

from .. import __version__
from ..job import write_atomically
from ..job.atomic import sha256
from ..job.json_file import Json, read_object
from ..job.scene_source import SceneSource
from ..metrics import MACHINE_MASKS, VOXEL_VOTE, PredictedView, Report, add_rivals
from ..scene import GroundTruth, Scene, SceneError, open_asked
from .figures import Figures, scores_by_method

VOXELS_ALONE = "voxel vote without objects"
RIVALS = (MACHINE_MASKS, VOXEL_VOTE, VOXELS_ALONE)
FORMAT = 2


class _WithoutObjects(Report):
    """Scores each answer of the voxels a second time, with no object told from another of its class."""

    def add_labels(self, method: str, frame: str, view: PredictedView, truth: GroundTruth) -> None:
        super().add_labels(method, frame, view, truth)
        if method == VOXEL_VOTE:
            alone = PredictedView(view.semantic, np.zeros_like(view.instance))
            super().add_labels(VOXELS_ALONE, frame, alone, truth)


WITH_IDS = (VOXEL_VOTE,)
"""Those whose ids mean the same in every frame, so that changes of them can be counted."""


def files_fingerprint(scene: Scene, results: Path) -> str:
    """A hash of the names, sizes and times of change of all files of the scene, masks and ground truth among them; of
    a scene in one file, of those beside it too. ``results``: a folder that is left out, as it may lie within the
    scene's. Raises SceneError."""
    is_folder, results = scene.folder.is_dir(), results.resolve()
    place = (scene.folder if is_folder else scene.folder.parent).resolve()
    fix = "Check that the scene's files are there and may be read."
    digest = hashlib.sha256(scene.format.encode())
    try:
        for path in sorted(place.rglob("*") if is_folder else (*place.glob("*"), *place.glob("*/*"))):
            if path.is_file() and results not in path.parents:
                name, facts = path.relative_to(place), path.stat()
                line = f"{name}\0{facts.st_size}\0{facts.st_mtime_ns}\n"
                digest.update(line.encode(errors="surrogateescape"))
    except OSError as error:
        raise SceneError(f"its files cannot be looked at ({error.strerror})", place, fix) from error
    return digest.hexdigest()


def scores_of_rivals(source: SceneSource, cache: Path) -> dict[str, Figures]:
    """Figures by method (RIVALS), measured once and kept in ``cache``, and measured anew when the engine, a file of the
    scene, or the format or classes that its masks were read by are others. Empty without ground truth.

    Raises SceneError when a file is bad, JobError when the cache is.
    """
    scene, classes = open_asked(source), source.classes
    made_of: dict[str, Json] = {
        "format": FORMAT,
        "engine_version": __version__,
        "files": files_fingerprint(scene, cache.parent),
        "mask_format": source.mask_format,
        "classes": sha256(Path(classes)) if classes and classes.endswith(".toml") else classes,
    }
    content = read_object(cache, "Delete it: the same command then makes it anew.") if cache.is_file() else {}
    if any(content.get(key) != value for key, value in made_of.items()):
        began, report = time.monotonic(), _WithoutObjects(scene.classes)
        add_rivals(report, scene)
        content = {**report.to_json(), **made_of}  # type: ignore[dict-item]
        content["seconds"] = round(time.monotonic() - began, 1)
        cache.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(cache, json.dumps(content, indent=1) + "\n")
    tables = content.get("tables")
    found = scores_by_method([each for each in tables if isinstance(each, dict)] if isinstance(tables, list) else [])
    return {name: each if name in WITH_IDS else each._replace(id_changes=None) for name, each in found.items()}
