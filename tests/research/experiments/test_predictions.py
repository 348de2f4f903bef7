"""Other people's predictions are rows beside ours, scored on the same held-out frames."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.job import ExitCode
from research.experiments.experiment import Experiment, SceneToLift
from research.experiments.predictions import predictions_from, with_predictions
from research.experiments.rows import Predicted
from research.results import read_results
from tests.raises_key import raises_key
from tests.research.experiments.made_up import ROWS
from tests.research.experiments.test_run import run
from tests.tiny_scene import write_tiny_scene


def experiment_of(folder: Path, *predictions: str) -> Experiment:
    """The true labels of two scenes as predictions, with the ids of things changed from frame to frame in "flicker"."""
    scenes = []
    for name in ("office", "kitchen"):
        scene = write_tiny_scene(folder / "scenes" / name, frames=20)
        scenes.append(SceneToLift(name, scene, "z"))
        for kind in ("true", "flicker"):
            shutil.copytree(scene / "gt", folder / kind / name / "gt")
        for number, path in enumerate(sorted((folder / "flicker" / name / "gt" / "instance").glob("*.png"))):
            ids = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(path), np.where(ids > 0, ids + 2 * number, 0).astype(ids.dtype))
    named = [predictions_from(each) for each in predictions]
    names = tuple(each.name for each in named)
    return Experiment(tuple(scenes), folder / "out", with_predictions(ROWS, named), only=(*names, "input masks"))


def test_predictions_are_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    true, flicker = f"{tmp_path}/true/{{scene}}", f"{tmp_path}/flicker/{{scene}}"
    experiment = experiment_of(tmp_path, f"theirs too={true}", f"ids={flicker}", f"detector={flicker}:ids=frame")
    assert run(experiment) is ExitCode.FINISHED
    found = {(one.scene, one.row): one.figures for one in read_results(experiment.folder / "results.json")}
    for scene in ("office", "kitchen"):
        theirs, ids, detector = (found[scene, name] for name in ("theirs too", "ids", "detector"))
        assert (theirs.miou, theirs.pq, theirs.pq_frame, theirs.id_changes) == (1.0, 1.0, 1.0, 0.0)
        assert ids.miou == detector.miou == ids.pq_frame == 1.0 and max(ids.pq or 1, detector.pq or 1) < 0.9
        assert ids.id_changes and detector.id_changes is None
    text = capsys.readouterr().out
    assert "| theirs too" in text and "### Means" in text


def test_a_frame_without_a_prediction_fails_the_row(tmp_path: Path) -> None:
    experiment = experiment_of(tmp_path, f"theirs too={tmp_path}/true/{{scene}}")
    for path in (tmp_path / "true" / "kitchen" / "gt").glob("*/0004.png"):
        path.unlink()
    held_out = {"0004"} & {path.stem for path in (tmp_path / "true" / "office" / "gt" / "semantic").glob("*.png")}
    assert held_out and run(experiment) is ExitCode.BAD_INPUT
    (failed,) = [one for one in read_results(experiment.folder / "results.json") if one.failed]
    assert failed.scene == "kitchen" and "held-out frames have no prediction, such as 0004" in failed.failed


def test_one_folder_for_several_scenes_is_refused(tmp_path: Path) -> None:
    with raises_key("shared-path --predictions"):
        run(experiment_of(tmp_path, f"theirs too={tmp_path}/true/office"))


def test_malformed_predictions_are_refused() -> None:
    assert predictions_from("a b=x/{scene}:ids=frame").predicted == Predicted(Path("x/{scene}"), True)
    for text in ("x", "=x", "x=", "x=:ids=frame"):
        with raises_key("not-a-prediction"):
            predictions_from(text)
    with raises_key("row-twice"):
        with_predictions(ROWS, [replace(predictions_from("Ours=x"))])
