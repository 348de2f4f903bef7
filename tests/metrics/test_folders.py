"""Labels in folders, in the layouts of several programs, against each other."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from engine.command_line.main import main
from engine.errors import PlgsError
from engine.export.frame_images import write_coco
from engine.metrics.report import score_folders
from engine.scene import Camera, Category, ClassTable
from engine.scene.label_folders import open_label_folder

CLASSES = ClassTable((Category(1, "wall", False, (9, 9, 9)), Category(5, "chair", True, (200, 9, 9))))
SEMANTIC = np.ones((12, 16), np.int32)
SEMANTIC[3:9, 2:14] = 5
INSTANCE = np.where(SEMANTIC == 5, 1 + (np.arange(16) > 7), 0).astype(np.int32)
FRAMES = ("0001", "0002")
CAMERA = Camera(16, 12, 20.0, 20.0, 8.0, 6.0, np.eye(4))


def write_pngs(folder: Path, semantic: str, instance: str, scale: int = 1, frames: tuple[str, ...] = FRAMES) -> Path:
    for name, values, kind in ((semantic, SEMANTIC, np.uint8), (instance, INSTANCE, np.uint16)):
        (folder / name).mkdir(parents=True)
        for frame in frames:
            pixels = values.repeat(scale, axis=0).repeat(scale, axis=1).astype(kind)
            cv2.imwrite(str(folder / name / f"{frame}.png"), pixels)
    return folder


def write_masks(folder: Path, instance: NDArray[np.int32] = INSTANCE) -> Path:
    write_coco(folder, CLASSES, ((frame, SEMANTIC, instance, CAMERA) for frame in FRAMES), {})
    return folder


def strict(predictions: Path, truth: Path, **options: bool) -> dict[str, float]:
    scores = score_folders(
        open_label_folder(predictions, is_truth=False), open_label_folder(truth, is_truth=True), **options
    )
    return scores["tables"][0]  # type: ignore[index]


@pytest.mark.parametrize(
    "pair",
    [("class", "instance"), ("gt/semantic", "gt/instance"), ("label-filt", "instance-filt"), ("classes", "instances")],
)
def test_masks_against_pngs(pair: tuple[str, str], tmp_path: Path) -> None:
    predictions, truth = write_masks(tmp_path / "masks"), write_pngs(tmp_path / "truth", *pair, scale=2)
    scores = strict(predictions, truth)
    assert (scores["miou"], scores["pq"], scores["pq_frame"], scores["id_changes"]) == (1.0, 1.0, 1.0, 0.0)
    detector = strict(predictions, truth, ids_per_frame=True)
    assert (detector["miou"], detector["pq"], detector["pq_frame"]) == (1.0, 0.5, 1.0)
    assert detector["id_changes"] == 1.0


def test_another_cut_of_the_picture_is_not_stretched_over_it(tmp_path: Path) -> None:
    """Square crops were scored as if they showed the whole picture."""
    truth, predictions = write_masks(tmp_path / "truth"), write_pngs(tmp_path / "cut", "class", "instance")
    for path in predictions.rglob("*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:, 2:14])
    with pytest.raises(PlgsError, match="frame 0001 has another shape than its ground truth of 16x12"):
        strict(predictions, truth)


def test_a_merged_chair(tmp_path: Path) -> None:
    merged = write_masks(tmp_path / "masks", np.minimum(INSTANCE, 1))
    scores = strict(merged, write_masks(tmp_path / "truth"))
    assert scores["miou"] == 1.0 and scores["pq"] == pytest.approx(0.5), "neither half is more than half of both"


def test_the_classes_of_an_export(tmp_path: Path) -> None:
    predictions = write_pngs(tmp_path / "predictions", "class", "instance")
    truth = write_pngs(tmp_path / "truth", "semantic", "instance")
    with pytest.raises(PlgsError, match="which are things"):
        strict(predictions, truth)
    classes = [{"id": one.id, "name": one.name, "is_thing": one.is_thing} for one in CLASSES.categories]
    (predictions / "labels.json").write_text(json.dumps({"classes": classes}))
    assert strict(predictions, truth)["pq"] == 1.0
    (truth / "labels.json").write_text(json.dumps({"classes": [{"id": 5, "name": "sofa", "is_thing": True}]}))
    with pytest.raises(PlgsError, match="its classes have other names than those in"):
        strict(predictions, truth)
    (truth / "labels.json").write_text("{}")
    with pytest.raises(PlgsError, match='no "classes"'):
        strict(predictions, truth)
    one = {"id": 5, "name": "chair", "is_thing": True}
    (truth / "labels.json").write_text(json.dumps({"classes": [one, one]}))
    with pytest.raises(PlgsError, match="has the id 5"):
        strict(predictions, truth)


@pytest.mark.parametrize(("second", "pq"), [("chair", 1.0), ("robot", 1 / 3)])
def test_predictions_in_another_table_are_mapped_by_name(second: str, pq: float, tmp_path: Path) -> None:
    """The truth has each other's numbers. A class that it lacks is an error wherever it is predicted."""
    predictions = write_pngs(tmp_path / "predictions", "class", "instance")
    truth = write_pngs(tmp_path / "truth", "semantic", "instance")
    for path in (truth / "semantic").iterdir():
        cv2.imwrite(str(path), np.where(SEMANTIC == 5, 1, 5).astype(np.uint8))
    for folder, ids in ((predictions, {"wall": 1, second: 5}), (truth, {"Wall": 5, "Chair": 1})):
        classes = [{"id": number, "name": name, "is_thing": name.lower() != "wall"} for name, number in ids.items()]
        (folder / "labels.json").write_text(json.dumps({"classes": classes}))
    assert strict(predictions, truth)["pq"] == pytest.approx(pq)


def test_frames_that_are_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    predictions = write_masks(tmp_path / "masks")
    few = write_pngs(tmp_path / "few", "class", "instance", frames=FRAMES[:1])
    with pytest.raises(PlgsError, match="0002"):
        strict(predictions, few)
    assert main(["evaluate", "--predictions", str(few), "--truth", str(predictions), "--json"]) == 0
    said = capsys.readouterr()
    assert "1 frames with ground truth" in said.err and json.loads(said.out)["test_frames"] == ["0001"]


@pytest.mark.parametrize(
    "arguments", [[], ["--predictions", "a"], ["a", "--predictions", "b", "--truth", "c"], ["--truth", "a"]]
)
def test_one_or_the_other(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", *arguments]) == 2
    assert "either LIFT" in capsys.readouterr().err


def test_a_folder_without_labels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = write_masks(tmp_path / "truth")
    for folder, told in ((tmp_path / "none", "not a folder"), (tmp_path, "no labels")):
        assert main(["evaluate", "--predictions", str(folder), "--truth", str(truth)]) == 2
        assert told in capsys.readouterr().err


def test_numbers_of_another_table_are_refused(tmp_path: Path) -> None:
    predictions = write_masks(tmp_path / "masks")
    truth = write_pngs(tmp_path / "truth", "semantic", "instance", scale=2)
    for path in (truth / "semantic").iterdir():
        cv2.imwrite(str(path), np.where(cv2.imread(str(path), -1) == 5, 62, 199).astype(np.uint8))
    with pytest.raises(PlgsError, match="its numbers look like coco:90, not like"):
        strict(predictions, truth)
