"""The report over a scene in memory, and over label folders in the layouts of several programs."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from engine.command_line.main import main
from engine.export.frame_images import write_coco
from engine.metrics.report import INPUT_MASKS, LIFTED, PredictedView, Report, add_input_masks, score_folders
from engine.scene import Camera, Category, ClassTable, Frame, GroundTruth, PanopticMask, Scene, Segment
from engine.scene.label_folders import open_label_folder
from tests.raises_key import raises_key, worded

CLASSES = ClassTable((Category(1, "wall", False, (9, 9, 9)), Category(5, "chair", True, (200, 9, 9))))
SIZE = (60, 40)
TRUE_CLASS = np.full((40, 60), 1, np.int32)
TRUE_CLASS[5:35, 5:25] = 5
TRUE_CLASS[5:35, 35:55] = 5
TRUE_ID = np.where(TRUE_CLASS == 5, 1 + (np.arange(60) > 30), 0).astype(np.int32)
PHOTO = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)


def _frame(index: int, wrong: bool) -> Frame:
    """A view whose input mask has ids of its own and, when ``wrong``, calls the left chair a wall."""
    ids = np.where(TRUE_CLASS == 5, TRUE_ID + 10 * (index + 1), 1).astype(np.int32)
    left = 11 + 10 * index
    segments = (Segment(1, 1, False), Segment(left, 1 if wrong else 5, not wrong), Segment(left + 1, 5, True))
    return Frame(
        name=f"{index:04d}",
        camera=Camera(*SIZE, 60.0, 60.0, 30.0, 20.0, np.eye(4)),
        held_out=index >= 3,
        colour_path=Path(),
        depth_path=Path(),
        read_colour=lambda size: PHOTO,
        read_depth=lambda size: np.full((40, 60), 2.0, np.float32),
        read_mask=lambda size: PanopticMask(ids, segments),
        read_ground_truth=lambda size: GroundTruth(TRUE_CLASS, TRUE_ID),
    )


SCENE = Scene(Path(), tuple(_frame(index, wrong=index in (1, 4)) for index in range(5)), CLASSES)


def _report_of_a_perfect_lift(scene: Scene) -> dict[str, object]:
    report = Report(scene.classes)
    for frame in scene.test_frames:
        report.add(LIFTED, frame, PredictedView(TRUE_CLASS, TRUE_ID, PHOTO))
    add_input_masks(report, scene)
    return report.to_json()


def test_the_report_scores_lift_and_masks_in_two_modes() -> None:
    metrics = _report_of_a_perfect_lift(SCENE)
    tables = {(table["name"], table["mode"]): table for table in metrics["tables"]}  # type: ignore[attr-defined]
    assert list(tables) == [(n, m) for n in (INPUT_MASKS, LIFTED) for m in ("strict", "pl_compat")]
    assert metrics["test_frames"] == ["0003", "0004"]
    lifted, masks = tables[LIFTED, "strict"], tables[INPUT_MASKS, "strict"]
    assert (lifted["miou"], lifted["miou_true"], lifted["pq"], lifted["psnr"]) == (1.0, 1.0, 1.0, 100.0)
    # Ids are new in every view: each true chair spans two views, so no segment covers more than half of it.
    assert masks["per_class"][1]["pq"] == 0.0
    assert {masks[key] for key in ("psnr", "psnr_fitted", "depth_error_m")} == {None}
    assert (lifted["psnr_fitted"], lifted["depth_error_m"]) == (100.0, None)
    assert json.loads(json.dumps(metrics, allow_nan=False)) == metrics


def test_without_ground_truth_only_pictures_are_scored() -> None:
    scene = replace(SCENE, frames=tuple(replace(f, read_ground_truth=None) for f in SCENE.frames))
    metrics = _report_of_a_perfect_lift(scene)
    (table,) = metrics["tables"]  # type: ignore[misc]
    assert (table["name"], table["mode"], table["miou"], table["psnr"]) == (LIFTED, None, None, 100.0)


def test_rendered_depth_is_scored() -> None:
    report, depth = Report(CLASSES), np.full((40, 60), 2.03, np.float32)
    depth[:4] = 3.0
    for frame in SCENE.test_frames:
        report.add(LIFTED, frame, PredictedView(TRUE_CLASS, TRUE_ID, PHOTO, depth, np.ones_like(depth)))
    for table in report.to_json()["tables"]:  # type: ignore[attr-defined]
        assert table["depth_error_m"] == pytest.approx(0.03, abs=1e-4)


def test_ground_truth_that_is_all_void_gives_no_scores() -> None:
    nothing = np.zeros((40, 60), np.int32)
    frame = replace(SCENE.frames[3], read_ground_truth=lambda size: GroundTruth(nothing, nothing))
    report = Report(CLASSES)
    report.add(INPUT_MASKS, frame, PredictedView(TRUE_CLASS, TRUE_ID))
    assert report.to_json()["tables"] == []


SEMANTIC = np.ones((12, 16), np.int32)
SEMANTIC[3:9, 2:14] = 5
INSTANCE = np.where(SEMANTIC == 5, 1 + (np.arange(16) > 7), 0).astype(np.int32)
NAMES = ("0001", "0002")
CAMERA = Camera(16, 12, 20.0, 20.0, 8.0, 6.0, np.eye(4))


def write_pngs(folder: Path, semantic: str, instance: str, scale: int = 1, frames: tuple[str, ...] = NAMES) -> Path:
    for name, values, kind in ((semantic, SEMANTIC, np.uint8), (instance, INSTANCE, np.uint16)):
        (folder / name).mkdir(parents=True)
        for frame in frames:
            pixels = values.repeat(scale, axis=0).repeat(scale, axis=1).astype(kind)
            cv2.imwrite(str(folder / name / f"{frame}.png"), pixels)
    return folder


def write_masks(folder: Path, instance: NDArray[np.int32] = INSTANCE) -> Path:
    write_coco(folder, CLASSES, ((frame, SEMANTIC, instance, CAMERA) for frame in NAMES), {})
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
def test_folders_of_label_pngs_are_scored_against_masks(pair: tuple[str, str], tmp_path: Path) -> None:
    predictions, truth = write_masks(tmp_path / "masks"), write_pngs(tmp_path / "truth", *pair, scale=2)
    scores = strict(predictions, truth)
    assert (scores["miou"], scores["pq"], scores["pq_frame"], scores["id_changes"]) == (1.0, 1.0, 1.0, 0.0)
    detector = strict(predictions, truth, ids_per_frame=True)
    assert (detector["miou"], detector["pq"], detector["pq_frame"]) == (1.0, 0.5, 1.0)
    assert detector["id_changes"] == 1.0


def test_predictions_cropped_differently_from_the_truth_are_refused(tmp_path: Path) -> None:
    truth, predictions = write_masks(tmp_path / "truth"), write_pngs(tmp_path / "cut", "class", "instance")
    for path in predictions.rglob("*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:, 2:14])
    with raises_key("truth-shape 0001 16x12"):
        strict(predictions, truth)


def test_two_chairs_merged_into_one_lower_pq(tmp_path: Path) -> None:
    merged = write_masks(tmp_path / "masks", np.minimum(INSTANCE, 1))
    scores = strict(merged, write_masks(tmp_path / "truth"))
    assert scores["miou"] == 1.0 and scores["pq"] == pytest.approx(0.5), "neither half is more than half of both"


def test_evaluate_reads_the_classes_of_an_export(tmp_path: Path) -> None:
    predictions = write_pngs(tmp_path / "predictions", "class", "instance")
    truth = write_pngs(tmp_path / "truth", "semantic", "instance")
    with raises_key("no-table"):
        strict(predictions, truth)
    classes = [{"id": one.id, "name": one.name, "is_thing": one.is_thing} for one in CLASSES.categories]
    (predictions / "labels.json").write_text(json.dumps({"classes": classes}))
    assert strict(predictions, truth)["pq"] == 1.0
    (truth / "labels.json").write_text(json.dumps({"classes": [{"id": 5, "name": "sofa", "is_thing": True}]}))
    with raises_key("other-classes"):
        strict(predictions, truth)
    (truth / "labels.json").write_text("{}")
    with raises_key("lacks-field classes"):
        strict(predictions, truth)
    one = {"id": 5, "name": "chair", "is_thing": True}
    (truth / "labels.json").write_text(json.dumps({"classes": [one, one]}))
    with raises_key("class-twice"):
        strict(predictions, truth)


@pytest.mark.parametrize(("second", "pq"), [("chair", 1.0), ("robot", 1 / 3)])
def test_predictions_with_another_class_table_are_mapped_by_name(second: str, pq: float, tmp_path: Path) -> None:
    """The truth swaps the two numbers. A class that it lacks is an error wherever it is predicted."""
    predictions = write_pngs(tmp_path / "predictions", "class", "instance")
    truth = write_pngs(tmp_path / "truth", "semantic", "instance")
    for path in (truth / "semantic").iterdir():
        cv2.imwrite(str(path), np.where(SEMANTIC == 5, 1, 5).astype(np.uint8))
    for folder, ids in ((predictions, {"wall": 1, second: 5}), (truth, {"Wall": 5, "Chair": 1})):
        classes = [{"id": number, "name": name, "is_thing": name.lower() != "wall"} for name, number in ids.items()]
        (folder / "labels.json").write_text(json.dumps({"classes": classes}))
    assert strict(predictions, truth)["pq"] == pytest.approx(pq)


def test_frames_without_prediction_are_reported_and_without_truth_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    predictions = write_masks(tmp_path / "masks")
    few = write_pngs(tmp_path / "few", "class", "instance", frames=NAMES[:1])
    with raises_key("no-truth 0002"):
        strict(predictions, few)
    assert main(["evaluate", "--predictions", str(few), "--truth", str(predictions), "--json"]) == 0
    said = capsys.readouterr()
    assert "1 frames with ground truth" in said.err and json.loads(said.out)["test_frames"] == ["0001"]


@pytest.mark.parametrize(
    "arguments", [[], ["--predictions", "a"], ["a", "--predictions", "b", "--truth", "c"], ["--truth", "a"]]
)
def test_evaluate_accepts_only_one_source_of_labels(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", *arguments]) == 2
    assert worded("evaluate-what").search(capsys.readouterr().err)


def test_evaluate_refuses_a_folder_without_labels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = write_masks(tmp_path / "truth")
    for folder, key in ((tmp_path / "none", "not-folder"), (tmp_path, "no-labels")):
        assert main(["evaluate", "--predictions", str(folder), "--truth", str(truth)]) == 2
        assert worded(key).search(capsys.readouterr().err)


def test_evaluate_refuses_class_numbers_of_another_table(tmp_path: Path) -> None:
    predictions = write_masks(tmp_path / "masks")
    truth = write_pngs(tmp_path / "truth", "semantic", "instance", scale=2)
    for path in (truth / "semantic").iterdir():
        cv2.imwrite(str(path), np.where(cv2.imread(str(path), -1) == 5, 62, 199).astype(np.uint8))
    with raises_key("truth-numbers coco:90"):
        strict(predictions, truth)
