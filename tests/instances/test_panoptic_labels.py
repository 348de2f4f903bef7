"""One label for class and object together."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.instances.panoptic_labels import UNKNOWN_LABEL, PanopticLabels, decide_labels
from tests.semantics.plane_views import CHAIR, CLASS_IDS, SOFA, WALL

LABELS = PanopticLabels(CLASS_IDS, (SOFA, CHAIR, SOFA))


def test_points_come_back_as_they_were() -> None:
    class_id = np.array([WALL, SOFA, CHAIR, SOFA, SOFA, 0, 99], np.int32)
    number = np.array([0, 0, 2, 1, 3, 0, 0], np.int32)
    labels = LABELS.of_points(class_id, number)
    assert labels.dtype == np.int32 and labels.tolist() == [0, 3, 5, 4, 6, UNKNOWN_LABEL, UNKNOWN_LABEL]
    assert LABELS.classes(labels).tolist() == [WALL, SOFA, CHAIR, SOFA, SOFA, 0, 0]
    np.testing.assert_array_equal(LABELS.objects(labels), number)


def plainly(row: np.ndarray, labels: PanopticLabels, least_share: float) -> tuple[int, float]:
    """``decide_labels`` of one row, word for word."""
    if not row.any():
        return UNKNOWN_LABEL, 0.0
    by_class = {class_id: 0.0 for class_id in labels.class_ids}
    for label, votes in enumerate(row.tolist()):
        by_class[int(labels.classes(np.array([label]))[0])] += votes
    class_id = max(by_class, key=lambda one: (by_class[one], -one))
    enough = np.float32(least_share) * np.float32(by_class[class_id])
    objects = [number for number, own in enumerate(labels.class_of_object, start=1) if own == class_id]
    votes_of = {number: row[labels.of_object(number)] for number in objects}
    shown = max(objects, key=lambda number: (votes_of[number], -number), default=0)
    if shown and votes_of[shown] > enough:
        return labels.of_object(shown), by_class[class_id] / row.sum()
    return labels.of_class(class_id), by_class[class_id] / row.sum()


@settings(max_examples=60, deadline=None)
@given(st.data(), st.integers(0, 10_000), st.sampled_from([0.0, 0.1, 0.25, 0.5]))
def test_every_row_gets_the_specified_label(data: st.DataObject, seed: int, least_share: float) -> None:
    objects = data.draw(st.lists(st.sampled_from(CLASS_IDS), max_size=6))
    labels = PanopticLabels(CLASS_IDS, tuple(objects))
    random = np.random.default_rng(seed)
    votes = random.integers(0, 4, (30, len(labels))).astype(np.float32) * random.integers(0, 2, (30, len(labels)))
    label, share = decide_labels(votes, labels, least_share)
    expected = [plainly(row, labels, least_share) for row in votes]
    assert label.tolist() == [each for each, _ in expected]
    np.testing.assert_allclose(share, [each for _, each in expected], rtol=1e-6)
