"""Segments and points that vote on panoptic labels in turn, and the neighbours that points share votes with."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_matrix

from engine.instances import segment_votes
from engine.instances.agreement import ViewPoints, ViewsOnCloud
from engine.instances.panoptic_labels import UNKNOWN_LABEL, PanopticLabels, decide_labels
from engine.instances.segment_votes import neighbours_on_a_thing, segment_labels, vote_panoptic_labels
from engine.presets.preset import EvidenceKind, SegmentVoting
from engine.scene import PanopticMask, Segment, View
from tests.semantics.plane_views import CHAIR, CLASS_IDS, SIZE, SOFA, WALL, square, wall_view


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.3, 0.5, 0.8]))
def test_segment_labels_match_a_plain_majority_vote(seed: int, agreement: float) -> None:
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


class VotedLabels(NamedTuple):
    label: np.ndarray
    confidence: np.ndarray


def vote(*given: Any, **how: Any) -> VotedLabels:
    return VotedLabels(*vote_panoptic_labels(*given, **how))


def voted(views: list[View], members: set[str], rounds: int = ROUNDS) -> VotedLabels:
    """The thing's masks in the views ``members`` are the object's. Each point is the surface of one pixel."""
    width, height = SIZE
    rows = np.arange(width * height, dtype=np.int32).reshape(height, width)
    members_of = {
        (view.name, segment.id): 1 for view in views for segment in view.mask.segments
        if view.name in members and segment.is_thing
    }  # fmt: skip
    seeing = ViewsOnCloud.of(views, [rows] * len(views))
    return vote(seeing, rows.size, LABELS, members_of, options=SegmentVoting(rounds), kind="root")


def wrong(found: np.ndarray) -> int:
    """Points that are not labelled as they should be."""
    return int((found.reshape(SIZE[::-1]) != square(OBJECT, WALL_LABEL, COLUMNS, ROWS)).sum())


def test_a_view_that_shows_the_wrong_class_is_outvoted_by_the_others() -> None:
    views = [drawn("a"), drawn("b"), drawn("c", class_id=CHAIR)]
    found = voted(views, {"a", "b"})
    assert wrong(found.label) == 0
    np.testing.assert_allclose(found.confidence, 1)
    # Without rounds the third view still says what its own mask does.
    alone = voted(views, {"a", "b"}, 0)
    assert wrong(alone.label) == 0 and alone.confidence.reshape(SIZE[::-1])[ROWS, COLUMNS] == pytest.approx(2 / 3)


def test_a_ragged_mask_outline_is_outvoted_by_other_views() -> None:
    ragged = drawn("c", columns=slice(COLUMNS.start - 2, COLUMNS.stop - 2))
    views = [drawn("a"), drawn("b"), ragged]
    found = voted(views, set("abc"))
    assert wrong(found.label) == 0
    # Labels of pixels keep the outlines of their own mask.


def test_a_segment_that_covers_two_objects_does_not_spoil_their_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    """One view draws the thing and as much of the wall as one segment: it has no say, but does no harm."""
    both = drawn("c", columns=slice(COLUMNS.start, COLUMNS.stop + 14))
    monkeypatch.setattr(segment_votes, "segment_labels", partial(segment_labels, agreement=0.6))
    views = [drawn("a"), drawn("b"), both]
    found = voted(views, set("ab"))
    assert wrong(found.label) == 0


def test_points_without_any_vote_are_unknown() -> None:
    view = drawn("a")
    found = voted([replace(view, mask=PanopticMask(np.zeros_like(view.mask.ids), ()))], set())
    assert (found.label == UNKNOWN_LABEL).all() and not found.confidence.any()


@pytest.mark.parametrize(("kind", "near_votes"), [("views", 1), ("root", 4), ("pixels", 16), ("density", 1)])
def test_a_points_votes_are_weighted_by_the_number_of_its_pixels(kind: EvidenceKind, near_votes: int) -> None:
    """One view shows a point with 16 pixels, five views at the same distance with one each."""
    near, far = np.full(SIZE[::-1], -1, np.int32), np.full(SIZE[::-1], -1, np.int32)
    near[:4, :4], far[0, 0] = 0, 0
    ids = np.ones(SIZE[::-1], np.int32)
    views = [
        replace(drawn(name), mask=PanopticMask(ids, (Segment(1, class_id, False),)))
        for name, class_id in (("near", CHAIR), *((f"far {i}", WALL) for i in range(5)))
    ]
    found = vote(ViewsOnCloud.of(views, [near, *[far] * 5]), 1, LABELS, {}, options=SegmentVoting(0), kind=kind)
    assert found.label.tolist() == [CHAIR_LABEL if near_votes > 5 else WALL_LABEL]
    assert found.confidence == pytest.approx(max(near_votes, 5) / (near_votes + 5))


SINK, TABLE = slice(18, 22), slice(0, 28)


@pytest.mark.parametrize(
    ("columns", "near", "expected"),
    [(SINK, True, OBJECT), (SINK, False, WALL_LABEL), (TABLE, True, WALL_LABEL), (TABLE, False, WALL_LABEL)],
)
def test_a_near_view_outvotes_far_views_on_objects_it_shows_whole(columns: slice, near: bool, expected: int) -> None:
    """It has three times the resolution of five views that draw no thing there. The picture's border cuts the table."""
    close = drawn("near", columns)
    close = replace(close, depth=close.depth / 3)
    rows = np.arange(SIZE[0] * SIZE[1], dtype=np.int32).reshape(SIZE[::-1])
    views = [close, *(wall_view(f"far {number}", 0.0) for number in range(5))]
    members, options = {("near", SOFA): 1}, SegmentVoting(0, near=near)
    found = vote(ViewsOnCloud.of(views, [rows] * 6), rows.size, LABELS, members, options=options, kind="resolution")
    assert (found.label.reshape(SIZE[::-1])[ROWS, columns] == expected).all()
    assert (found.label != expected).any() == (expected == OBJECT)


def test_a_point_also_counts_the_votes_of_its_neighbours() -> None:
    """Three points: the first is seen as a chair, its neighbour by two views as a wall, the third has no neighbour."""
    rows = np.full(SIZE[::-1], -1, np.int32)
    views, shown = [], []
    for number, (point, class_id) in enumerate([(0, CHAIR), (1, WALL), (1, WALL), (2, CHAIR)]):
        views.append(wall_view(f"{number}", 0.0, classes=class_id))
        shown.append(np.where(np.arange(rows.size).reshape(rows.shape) == 0, point, rows).astype(np.int32))
    neighbours = csr_matrix(np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]], np.float32))
    found = vote(
        ViewsOnCloud.of(views, shown), 3, LABELS, {}, options=SegmentVoting(0), kind="views", neighbours=neighbours
    )
    assert found.label.tolist() == [WALL_LABEL, WALL_LABEL, CHAIR_LABEL]
    np.testing.assert_allclose(found.confidence, [2 / 3, 2 / 3, 1])


def test_deciding_labels_in_parts_gives_the_same_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    views = [drawn("a"), drawn("b"), drawn("c", class_id=CHAIR)]
    whole = voted(views, {"a", "b"})
    monkeypatch.setattr(segment_votes, "CELLS_AT_A_TIME", 37 * len(LABELS))
    parts = voted(views, {"a", "b"})
    np.testing.assert_array_equal(parts.label, whole.label)
    np.testing.assert_array_equal(parts.confidence, whole.confidence)


SPACING = 0.05
ACROSS = 6
XYZ = np.array([[SPACING * x, SPACING * y, 0.0] for y in range(3) for x in range(ACROSS)], np.float32)
LEFT = np.arange(len(XYZ)) % ACROSS < ACROSS // 2


def seen_as(segment: np.ndarray, resolution: float, rows: np.ndarray | None = None) -> ViewPoints:
    """A view that shows these segments at the points ``rows`` (all)."""
    row = np.arange(len(XYZ)) if rows is None else rows
    return ViewPoints(
        row.astype(np.int32),
        segment[row].astype(np.int32),
        np.ones(len(row), np.float32),
        np.full(len(row), resolution, np.float32),
    )


SURFACE, WITH_PICTURE = np.ones(len(XYZ)), np.where(LEFT, 1, 2)


def crosses(views: list[ViewPoints]) -> bool:
    """Whether any point left has a neighbour to the right."""
    return bool(neighbours_on_a_thing(XYZ, SPACING, views)[LEFT][:, ~LEFT].nnz)


def test_points_across_a_mask_outline_of_most_views_share_no_votes() -> None:
    assert crosses([seen_as(SURFACE, 1.0)]) and not crosses([seen_as(WITH_PICTURE, 1.0)])
    assert not crosses([seen_as(WITH_PICTURE, 3.0), seen_as(SURFACE, 1.0), seen_as(SURFACE, 1.0)])
    assert crosses([seen_as(WITH_PICTURE, 1.0), seen_as(SURFACE, 1.0), seen_as(SURFACE, 1.0)])
    assert not crosses([seen_as(WITH_PICTURE, 1.0), seen_as(np.where(LEFT, 0, 1), 9.0)]), "void says nothing"


def test_the_vote_weights_of_a_points_neighbours_sum_to_one() -> None:
    weights = neighbours_on_a_thing(XYZ, SPACING, [seen_as(SURFACE, 1.0)])
    np.testing.assert_allclose(np.asarray(weights.sum(1)).reshape(-1), 1.0, rtol=1e-6)
    assert weights.diagonal().max() == 0.0 and (weights.getnnz(1) <= 6).all()
    there = XYZ[weights.tocoo().row] - XYZ[weights.tocoo().col]
    assert np.linalg.norm(there, axis=1).max() <= 2 * SPACING + 1e-6


def test_points_that_no_view_shows_together_share_no_votes() -> None:
    half = seen_as(SURFACE, 1.0, np.flatnonzero(LEFT)), seen_as(SURFACE, 1.0, np.flatnonzero(~LEFT))
    assert not crosses([*half])
    assert neighbours_on_a_thing(XYZ, SPACING, []).nnz == 0
    alone = np.concatenate([XYZ, [[9.0, 9.0, 9.0]]])
    assert neighbours_on_a_thing(alone, SPACING, [seen_as(SURFACE, 1.0)]).getnnz(1)[-1] == 0


TWO_SOFAS_AND_A_CHAIR = PanopticLabels(CLASS_IDS, (SOFA, CHAIR, SOFA))


def test_classes_and_objects_survive_the_conversion_to_panoptic_labels() -> None:
    class_id = np.array([WALL, SOFA, CHAIR, SOFA, SOFA, 0, 99], np.int32)
    number = np.array([0, 0, 2, 1, 3, 0, 0], np.int32)
    labels = TWO_SOFAS_AND_A_CHAIR.of_points(class_id, number)
    assert labels.dtype == np.int32 and labels.tolist() == [0, 3, 5, 4, 6, UNKNOWN_LABEL, UNKNOWN_LABEL]
    assert TWO_SOFAS_AND_A_CHAIR.classes(labels).tolist() == [WALL, SOFA, CHAIR, SOFA, SOFA, 0, 0]
    np.testing.assert_array_equal(TWO_SOFAS_AND_A_CHAIR.objects(labels), number)


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
def test_decided_labels_match_a_plain_implementation(data: st.DataObject, seed: int, least_share: float) -> None:
    objects = data.draw(st.lists(st.sampled_from(CLASS_IDS), max_size=6))
    labels = PanopticLabels(CLASS_IDS, tuple(objects))
    random = np.random.default_rng(seed)
    votes = random.integers(0, 4, (30, len(labels))).astype(np.float32) * random.integers(0, 2, (30, len(labels)))
    label, share = decide_labels(votes, labels, least_share)
    expected = [plainly(row, labels, least_share) for row in votes]
    assert label.tolist() == [each for each, _ in expected]
    np.testing.assert_allclose(share, [each for _, each in expected], rtol=1e-6)
