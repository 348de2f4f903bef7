"""Other people's predictions as rows: labels of the held-out frames in a folder, made by any program."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from glob import glob, has_magic
from pathlib import Path

from engine.batch.plan import of_scene
from engine.errors import PlgsError
from engine.metrics.report import PREDICTIONS, score_folders
from engine.scene import Frame, GroundTruth, Scene, open_asked
from engine.scene.label_folders import LabelFolder, open_label_folder
from engine.scene_source import UP_OPTIONS, UpAxis

from ..results import Figures, Result, scores_by_method, this_engine
from .experiment import Experiment
from .rows import Predicted, Row, Rows

# The scenes that a command line names: ``SCENE`` or ``SCENE:up=y``.

_SCENE = re.compile(r"(?P<folder>.+?)(?::up=(?P<up>.*))?", re.DOTALL)
_NAME = re.compile(r"\w[\w .+-]*")
"""A name becomes part of a folder's name, and a cell of a Markdown table."""


@dataclass(frozen=True)
class SceneToLift:
    """A scene's folder (absolute), the axis of its poses that points up, and what tables call it."""

    name: str
    folder: Path
    up: UpAxis = "z"


def scenes_from(texts: Sequence[str], names: Sequence[str] | None = None) -> tuple[SceneToLift, ...]:
    """The scenes of ``texts``, each ``SCENE`` or ``SCENE:up=AXIS``, called ``names`` or as their folders are. SCENE may
    be a pattern of folders, such as ``scans/scene*``, which stands for all of them in the order of their names.

    Raises PlgsError when an axis or a name is invalid, when two names are the same, or when the numbers differ.
    """
    texts = [each for text in texts for each in _matching(text)]
    if names is not None and len(names) != len(texts):
        what = f"{len(names)} names for {len(texts)} scenes"
        raise PlgsError("unequal-counts", what, ",".join(names), "Give a name for each scene.")
    scenes = [_scene(text) for text in texts]
    if names is not None:
        scenes = [SceneToLift(name, scene.folder, scene.up) for name, scene in zip(names, scenes, strict=True)]
    known: set[str] = set()
    for scene in scenes:
        if not _NAME.fullmatch(scene.name):
            fix = "Give names of letters, digits and - with --names."
            raise PlgsError("scene-unnamable", f"{scene.name!r} cannot be a scene's name", scene.folder, fix)
        if scene.name.casefold() in known:  # on some disks Office and office are the same folder
            what = f"two scenes are called {scene.name}"
            raise PlgsError("names-clash", what, scene.folder, "Give other names with --names.")
        known.add(scene.name.casefold())
    return tuple(scenes)


def _matching(text: str) -> list[str]:
    """The scenes that a text means. Raises PlgsError for a pattern that matches no folder."""
    match = _SCENE.fullmatch(text)
    if match is None or not has_magic(match["folder"]) or Path(match["folder"]).exists():
        return [text]
    axis = text[len(match["folder"]) :]
    found = sorted(folder for folder in glob(match["folder"]) if Path(folder).is_dir())
    if not found:
        what = "no folder matches the pattern"
        raise PlgsError("no-match", what, text, "Name folders of scenes, or another pattern.")
    return [folder + axis for folder in found]


def _scene(text: str) -> SceneToLift:
    match = _SCENE.fullmatch(text)
    if match is None:
        raise PlgsError("not-scene", "is not a scene", repr(text), "Give the scene's folder.")
    up = match["up"] if match["up"] is not None else "auto"
    if up not in UP_OPTIONS:
        fix = f"Write SCENE:up= and one of {', '.join(UP_OPTIONS)}."
        raise PlgsError("not-axis", f"{up!r} is not an axis that can point up", text, fix)
    folder = Path(match["folder"]).resolve()
    return SceneToLift(folder.name, folder, UP_OPTIONS[up])


_PER_FRAME = ":ids=frame"
_FIX = (
    f"Write NAME=FOLDER, such as 'other=predictions/{{scene}}', and add {_PER_FRAME} if ids hold within a frame only."
)


@dataclass(frozen=True)
class NamedPredictions:
    """The value of --predictions."""

    name: str
    predicted: Predicted


def predictions_from(text: str) -> NamedPredictions:
    """NAME=FOLDER, or NAME=FOLDER:ids=frame. Raises PlgsError."""
    name, equals, folder = text.partition("=")
    name, per_frame = name.strip(), folder.endswith(_PER_FRAME)
    folder = folder.removesuffix(_PER_FRAME)
    if not equals or not name or not folder or not name.isprintable():
        raise PlgsError("not-a-prediction", "is not a name and a folder", text, _FIX, option="--predictions")
    return NamedPredictions(name, Predicted(Path(folder), per_frame))


def with_predictions(rows: Rows, given: list[NamedPredictions]) -> Rows:
    """The rows, and one more of the first table for each of the predictions. Raises PlgsError for a name that a row
    has."""
    known = {row.name.casefold() for row in rows.rows}
    for each in given:
        if each.name.casefold() in known:
            what = "there is a row of this name"
            raise PlgsError("row-twice", what, each.name, "Give another.", option="--predictions")
        known.add(each.name.casefold())
    first = next(iter(rows.tables))
    return replace(rows, rows=(*rows.rows, *(Row(each.name, first, predicted=each.predicted) for each in given)))


def results_of_predictions(experiment: Experiment, errors: dict[str, PlgsError]) -> Iterator[Result]:
    """The results of the rows that are predictions. If one fails, it has the reason, and ``errors`` gets it."""
    rows = [row for row in experiment.rows.rows if row.predicted]
    for scene in experiment.scenes if rows else ():
        for row in rows:
            about = scene.name, row.name, "-", 0, 0, this_engine()
            try:
                yield Result(*about, scores_of(row, scene, open_asked(experiment.source(scene))))
            except PlgsError as error:
                errors[f"{scene.name}: {row.name}"] = error
                yield Result(*about, failed=str(error))


def scores_of(row: Row, scene: SceneToLift, opened: Scene) -> Figures:
    """The figures of a row's predictions of the held-out frames of a scene. Raises PlgsError, also if one of the
    frames that have ground truth lacks a prediction: figures of fewer frames compare with nothing."""
    assert row.predicted is not None
    place = of_scene(row.predicted.folder, scene.name)
    assert place is not None
    found = open_label_folder(place, is_truth=False)
    readers = {frame.name: partial(_truth, frame) for frame in opened.test_frames if frame.read_ground_truth}
    if not readers:
        what = "no held-out frame has ground truth"
        raise PlgsError("no-truth", what, opened.folder, "Compare on scenes that have it.")
    if lacking := [name for name in readers if name not in found.readers]:
        what = f"{len(lacking)} of {len(readers)} held-out frames have no prediction, such as {lacking[0]}"
        raise PlgsError("no-prediction", what, place, "Give an image the name of its frame.")
    predictions = replace(found, readers={name: found.readers[name] for name in readers})
    truth = LabelFolder(opened.folder, opened.classes, readers)
    tables = score_folders(predictions, truth, ids_per_frame=row.predicted.ids_per_frame)["tables"]
    figures = scores_by_method(tables)[PREDICTIONS]  # type: ignore[arg-type]
    return figures._replace(id_changes=None) if row.predicted.ids_per_frame else figures


def _truth(frame: Frame) -> GroundTruth:
    assert frame.read_ground_truth is not None
    return frame.read_ground_truth(frame.size)
