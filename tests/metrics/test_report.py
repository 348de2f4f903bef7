"""The report over a scene held in memory."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.metrics.report import INPUT_MASKS, LIFTED, PredictedView, Report, add_input_masks
from engine.scene import Camera, Category, ClassTable, Frame, GroundTruth, PanopticMask, Scene, Segment

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


def test_two_methods_in_two_modes() -> None:
    metrics = _report_of_a_perfect_lift(SCENE)
    tables = {(table["name"], table["mode"]): table for table in metrics["tables"]}  # type: ignore[attr-defined]
    assert list(tables) == [(n, m) for n in (INPUT_MASKS, LIFTED) for m in ("strict", "pl_compat")]
    assert metrics["test_frames"] == ["0003", "0004"]
    lifted, masks = tables[LIFTED, "strict"], tables[INPUT_MASKS, "strict"]
    assert (lifted["miou"], lifted["miou_true"], lifted["pq"], lifted["psnr"]) == (1.0, 1.0, 1.0, 100.0)
    # Ids are new in every view: each true chair spans two views, so no segment covers more than half of it.
    assert masks["per_class"][1]["pq"] == 0.0
    assert {masks[key] for key in ("psnr", "ssim_fitted", "depth_error_m", "depth_within_5cm")} == {None}
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
        assert table["depth_within_5cm"] == pytest.approx(0.9)


def test_void_ground_truth_gives_no_table() -> None:
    nothing = np.zeros((40, 60), np.int32)
    frame = replace(SCENE.frames[3], read_ground_truth=lambda size: GroundTruth(nothing, nothing))
    report = Report(CLASSES)
    report.add(INPUT_MASKS, frame, PredictedView(TRUE_CLASS, TRUE_ID))
    assert report.to_json()["tables"] == []


def test_a_view_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="differ"):
        Report(CLASSES).add(LIFTED, SCENE.frames[3], PredictedView(TRUE_CLASS[1:], TRUE_ID[1:]))
