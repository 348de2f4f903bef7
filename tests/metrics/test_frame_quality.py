"""PQ frame by frame, and how often objects change their ids."""

from __future__ import annotations

import numpy as np
import pytest

from engine.metrics.panoptic import FrameQuality, IdChanges, PanopticEvaluation
from engine.scene import Category, ClassTable

CLASSES = ClassTable((Category(1, "wall", False, (9, 9, 9)), Category(5, "chair", True, (200, 9, 9))))
TRUE = np.array([[1, 1, 1, 5, 5, 5, 5, 5]], np.int32)
CHAIRS = np.array([[0, 0, 0, 1, 1, 2, 2, 2]], np.int32)


def scores_of(predicted_ids: list[list[int]]) -> tuple[FrameQuality, IdChanges]:
    """Of frames with the right classes and these ids."""
    quality, changes = FrameQuality(CLASSES), IdChanges(CLASSES)
    for ids in predicted_ids:
        shared = PanopticEvaluation(CLASSES, "strict").add(TRUE, np.array([ids], np.int32), TRUE, CHAIRS)
        quality.add(shared)
        changes.add(shared)
    return quality, changes


def test_ids_that_change_between_frames_do_not_lower_per_frame_scores() -> None:
    quality, changes = scores_of([[0, 0, 0, 1, 1, 2, 2, 2], [0, 0, 0, 7, 7, 8, 8, 8], [0, 0, 0, 7, 7, 9, 9, 9]])
    assert quality.pq == 1.0
    assert changes.per_object == pytest.approx((1 + 2) / 2)


def test_a_merged_object_is_found_once_and_tracked_to_its_place() -> None:
    quality, changes = scores_of([[0, 0, 0, 1, 1, 2, 2, 2], [0, 0, 0, 2, 2, 2, 2, 2], [0, 0, 0, 1, 1, 2, 2, 2]])
    # Chairs: 5 found, one of them with IoU 3/5; the missed one is one error, the merged one none.
    assert quality.pq == pytest.approx((1 + 4.6 / (5 + 0.5)) / 2)
    assert changes.per_object == 0.0, "out of sight for a frame, and the same afterwards"


def test_nothing_to_score() -> None:
    quality, changes = scores_of([])
    assert quality.pq is None and changes.per_object is None
    assert scores_of([[0, 0, 0, 1, 1, 2, 2, 2]])[1].per_object is None, "seen once"
