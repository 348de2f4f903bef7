"""Segments and points that vote on panoptic labels in turn."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.instances import segment_votes
from engine.instances.agreement import ViewsOnCloud
from engine.instances.panoptic_labels import UNKNOWN_LABEL, PanopticLabels
from engine.instances.segment_votes import (
    VotedLabels,
    member_labels,
    segment_labels,
    vote_panoptic_labels,
)
from engine.presets.preset import EvidenceKind
from engine.scene import PanopticMask, Segment, View
from tests.semantics.plane_views import CHAIR, CLASS_IDS, SIZE, SOFA, WALL, square, wall_view


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.3, 0.5, 0.8]))
def test_every_segment_gets_the_specified_label(seed: int, agreement: float) -> None:
    random = np.random.default_rng(seed)
    mask = PanopticMask(random.integers(0, 6, (4, 7)).astype(np.int32) * 1000, ())
    shown = random.integers(-1, 3, (4, 7))
    expected = np.full((4, 7), UNKNOWN_LABEL)
    for segment in np.unique(mask.ids[mask.ids > 0]):
        own = mask.ids == segment
        votes = np.bincount(shown[own & (shown >= 0)], minlength=3)
        agreed = votes.any() and votes.max() >= agreement * votes.sum()
        expected[own] = votes.argmax() if agreed else shown[own]
    found = segment_labels(mask, shown, 3, agreement)
    assert found.dtype == np.int16
    np.testing.assert_array_equal(found, expected)


LABELS = PanopticLabels(CLASS_IDS, (SOFA,))
WALL_LABEL, CHAIR_LABEL, OBJECT = 0, 2, 4
COLUMNS, ROWS = slice(12, 28), slice(8, 22)
ROUNDS = 2


def drawn(name: str, columns: slice = COLUMNS, class_id: int = SOFA, rows: slice = ROWS) -> View:
    """A view from one place for all, so that pixel and point are the same: a thing on a wall."""
    return wall_view(name, 0.0, classes=square(class_id, WALL, columns, rows).astype(np.int32))


def voted(views: list[View], members: set[str], rounds: int = ROUNDS) -> VotedLabels:
    """The thing's masks in the views ``members`` are the object's. Each point is the surface of one pixel."""
    width, height = SIZE
    rows = np.arange(width * height, dtype=np.int32).reshape(height, width)
    members_of = {
        (view.name, segment.id): 1 for view in views for segment in view.mask.segments
        if view.name in members and segment.is_thing
    }  # fmt: skip
    seeing = ViewsOnCloud.of(views, [rows] * len(views))
    return vote_panoptic_labels(seeing, rows.size, LABELS, members_of, rounds, "root")


def wrong(found: np.ndarray) -> int:
    """Points, or pixels, that are not labelled as they should be."""
    return int((found.reshape(SIZE[::-1]) != square(OBJECT, WALL_LABEL, COLUMNS, ROWS)).sum())


def test_a_view_says_which_objects_its_masks_belong_to() -> None:
    view = drawn("a")
    assert wrong(member_labels(view, LABELS, {("a", SOFA): 1})) == 0
    plain = member_labels(view, LABELS, {("b", SOFA): 1})
    assert plain[ROWS, COLUMNS].max() == plain[ROWS, COLUMNS].min() == LABELS.of_class(SOFA)
    ids = np.where(view.mask.ids == WALL, 0, view.mask.ids)
    void = replace(view, mask=PanopticMask(ids, (*view.mask.segments, Segment(90, CHAIR, True))))
    assert (member_labels(void, LABELS, {})[0] == UNKNOWN_LABEL).all()


def test_a_view_with_the_wrong_class_is_corrected_by_the_others() -> None:
    views = [drawn("a"), drawn("b"), drawn("c", class_id=CHAIR)]
    found = voted(views, {"a", "b"})
    assert wrong(found.label) == 0
    assert [wrong(each) for each in found.maps] == [0, 0, 0]
    np.testing.assert_allclose(found.confidence, 1)
    # Without rounds the third view still says what its own mask does.
    alone = voted(views, {"a", "b"}, 0)
    assert wrong(alone.label) == 0 and alone.confidence.reshape(SIZE[::-1])[ROWS, COLUMNS] == pytest.approx(2 / 3)
    assert wrong(alone.maps[0]) == 0 and (alone.maps[2][ROWS, COLUMNS] == CHAIR_LABEL).all()


def test_a_ragged_outline_is_outvoted() -> None:
    ragged = drawn("c", columns=slice(COLUMNS.start - 2, COLUMNS.stop - 2))
    views = [drawn("a"), drawn("b"), ragged]
    found = voted(views, set("abc"))
    assert wrong(found.label) == 0
    # Labels of pixels keep the outlines of their own mask.
    assert [wrong(each) for each in found.maps] == [0, 0, 4 * (ROWS.stop - ROWS.start)]


def test_a_segment_over_two_things_votes_point_by_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """One view draws the thing and as much of the wall as one segment: it has no say, but does no harm."""
    both = drawn("c", columns=slice(COLUMNS.start, COLUMNS.stop + 14))
    monkeypatch.setattr(segment_votes, "segment_labels", partial(segment_labels, agreement=0.6))
    views = [drawn("a"), drawn("b"), both]
    found = voted(views, set("ab"))
    assert wrong(found.label) == 0 and [wrong(each) for each in found.maps] == [0, 0, 0]


def test_what_no_view_labels_is_unknown() -> None:
    view = drawn("a")
    found = voted([replace(view, mask=PanopticMask(np.zeros_like(view.mask.ids), ()))], set())
    assert (found.label == UNKNOWN_LABEL).all() and not found.confidence.any()
    assert (found.maps[0] == UNKNOWN_LABEL).all()


@pytest.mark.parametrize(("kind", "near_votes"), [("views", 1), ("root", 4), ("pixels", 16), ("density", 1)])
def test_a_point_has_votes_by_the_evidence(kind: EvidenceKind, near_votes: int) -> None:
    """One view shows a point with 16 pixels, five views at the same distance with one each."""
    near, far = np.full(SIZE[::-1], -1, np.int32), np.full(SIZE[::-1], -1, np.int32)
    near[:4, :4], far[0, 0] = 0, 0
    ids = np.ones(SIZE[::-1], np.int32)
    views = [
        replace(drawn(name), mask=PanopticMask(ids, (Segment(1, class_id, False),)))
        for name, class_id in (("near", CHAIR), *((f"far {i}", WALL) for i in range(5)))
    ]
    found = vote_panoptic_labels(ViewsOnCloud.of(views, [near, *[far] * 5]), 1, LABELS, {}, 0, kind)
    assert found.label.tolist() == [CHAIR_LABEL if near_votes > 5 else WALL_LABEL]
    assert found.confidence == pytest.approx(max(near_votes, 5) / (near_votes + 5))


def test_many_points_are_decided_a_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    views = [drawn("a"), drawn("b"), drawn("c", class_id=CHAIR)]
    whole = voted(views, {"a", "b"})
    monkeypatch.setattr(segment_votes, "ROWS_AT_A_TIME", 37)
    parts = voted(views, {"a", "b"})
    np.testing.assert_array_equal(parts.label, whole.label)
    np.testing.assert_array_equal(parts.confidence, whole.confidence)
