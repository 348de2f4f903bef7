"""Other people's predictions as rows: labels of the held-out frames in a folder, made by any program."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from engine.batch.plan import of_scene
from engine.errors import PlgsError
from engine.metrics.report import PREDICTIONS, score_folders
from engine.scene import Frame, GroundTruth, Scene, open_asked
from engine.scene.label_folders import LabelFolder, open_label_folder

from ..results import Figures, Result, scores_by_method, this_engine
from .experiment import Experiment, SceneToLift
from .rows import Predicted, Row, Rows

_PER_FRAME = ":ids=frame"
_FIX = (
    f"Write NAME=FOLDER, such as 'other=predictions/{{scene}}', and add {_PER_FRAME} if ids hold only within a frame."
)


def predictions_from(text: str) -> Row:
    """The row for NAME=FOLDER, or NAME=FOLDER:ids=frame, in no table yet. Raises PlgsError."""
    name, equals, folder = text.partition("=")
    name, per_frame = name.strip(), folder.endswith(_PER_FRAME)
    folder = folder.removesuffix(_PER_FRAME)
    if not equals or not name or not folder or not name.isprintable():
        raise PlgsError("not-a-prediction", "is not of the form NAME=FOLDER", text, _FIX, option="--predictions")
    return Row(name, "", predicted=Predicted(Path(folder), per_frame))


def with_predictions(rows: Rows, given: list[Row]) -> Rows:
    """The rows, plus those of predictions in the first table. Raises PlgsError for a name that a row already
    has."""
    known = {row.name.casefold() for row in rows.rows}
    for each in given:
        if each.name.casefold() in known:
            what = "a row already has this name"
            raise PlgsError("row-twice", what, each.name, "Give another name.", option="--predictions")
        known.add(each.name.casefold())
    first = next(iter(rows.tables))
    return replace(rows, rows=(*rows.rows, *(replace(each, table=first) for each in given)))


def results_of_predictions(experiment: Experiment, errors: dict[str, PlgsError]) -> Iterator[Result]:
    """The results of the rows that are predictions. A failed one carries its reason, which is also put into
    ``errors``."""
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
    """The figures of a row's predictions of the held-out frames of a scene. Raises PlgsError, also if a frame with
    ground truth lacks a prediction: figures over fewer frames could not be compared."""
    assert row.predicted is not None
    folder = of_scene(row.predicted.folder, scene.name)
    assert folder is not None
    found = open_label_folder(folder, is_truth=False)
    readers = {frame.name: partial(_truth, frame) for frame in opened.test_frames if frame.read_ground_truth}
    if not readers:
        what = "no held-out frame has ground truth"
        raise PlgsError("no-truth", what, opened.folder, "Choose scenes with ground truth.")
    if lacking := [name for name in readers if name not in found.readers]:
        what = f"{len(lacking)} of {len(readers)} held-out frames have no prediction, such as {lacking[0]}"
        raise PlgsError("no-prediction", what, folder, "Name each image after its frame.")
    predictions = replace(found, readers={name: found.readers[name] for name in readers})
    truth = LabelFolder(opened.folder, opened.classes, readers)
    tables = score_folders(predictions, truth, ids_per_frame=row.predicted.ids_per_frame)["tables"]
    figures = scores_by_method(tables)[PREDICTIONS]  # type: ignore[arg-type]
    return figures._replace(id_changes=None) if row.predicted.ids_per_frame else figures


def _truth(frame: Frame) -> GroundTruth:
    assert frame.read_ground_truth is not None
    return frame.read_ground_truth(frame.size)
