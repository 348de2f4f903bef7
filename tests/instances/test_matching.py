"""Algorithm 1, and the boxes that it compares."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.instances.matching import class_by_views, match_views, pair_cost, update_instances
from engine.instances.records import ObjectMask, OrientedBox, fit_box, intersection_volume
from engine.instances.segments import SegmentOptions, local_instances
from engine.presets.preset import Matching
from engine.scene import Camera, PanopticMask, Segment, View
from tests.instances.two_chairs import CHAIR, SOFA, THINGS, look, view_of

LEFT = ((-0.56, -0.25, 0.0), (-0.06, 0.25, 0.8))
RIGHT = ((0.06, -0.25, 0.0), (0.56, 0.25, 0.8))
CHAIRS = [LEFT, RIGHT]
SEGMENTS = SegmentOptions(voxel_size=0.03)
SIZE = (160, 120)


def around(angle: float, distance: float = 2.5) -> Camera:
    x, y = distance * np.sin(np.radians(angle)), -distance * np.cos(np.radians(angle))
    return look((x, y, 1.4), (0.0, 0.0, 0.4), SIZE)


def orbit(boxes: list, bleed: int = 0) -> list[View]:
    return [view_of(f"{angle:03}", around(angle), boxes, bleed) for angle in range(0, 360, 30)]


def only(view: View, keep: int) -> View:
    """The same view with one chair's segment missed."""
    ids = np.where((view.mask.ids > 1) & (view.mask.ids != keep), 0, view.mask.ids).astype(np.int32)
    return replace(view, mask=PanopticMask(ids, tuple(s for s in view.mask.segments if s.id in (1, keep))))


def test_two_chairs_12_cm_apart_stay_two_objects() -> None:
    found = match_views(orbit(CHAIRS), THINGS, SEGMENTS, Matching())
    assert len(found) == 2 and [len(item.masks) > 6 for item in found] == [True, True]
    for item, (low, high) in zip(sorted(found, key=lambda i: i.box.centre[0]), CHAIRS, strict=True):
        np.testing.assert_allclose(item.box.centre, np.add(low, high) / 2, atol=0.06)


def test_two_chairs_never_seen_in_one_view_stay_two_objects() -> None:
    views = [only(view, 2 + i % 2) for i, view in enumerate(orbit(CHAIRS))]
    assert len(match_views(views, THINGS, SEGMENTS, Matching())) == 2


def test_one_chair_seen_from_two_sides_becomes_one_object() -> None:
    views = [view_of("front", around(0), [LEFT]), view_of("side", around(80), [LEFT])]
    first, second = (local_instances(view, THINGS, SEGMENTS)[0] for view in views)
    # The two visible halves overlap in a corner only: it is IoM that finds them.
    assert pair_cost(first.box, second.box) < -0.1
    found = match_views(views, THINGS, SEGMENTS, Matching())
    assert len(found) == 1 and found[0].views == 2
    counts = [len(match_views(views, THINGS, SEGMENTS, Matching(tau_new=-0.4, cost=one))) for one in ("IoU", "IoM")]
    assert counts == [2, 1], "IoU alone does not find them"
    assert found[0].masks[0].cost is None and found[0].masks[1].cost is not None


def test_a_chair_split_into_two_segments_becomes_one_object() -> None:
    views = orbit([LEFT])
    for at in (3, 6):
        ids = views[at].mask.ids.copy()
        rows, columns = np.nonzero(ids == 2)
        upper = rows < np.median(rows)
        ids[rows[upper], columns[upper]] = 9
        mask = PanopticMask(ids, (*views[at].mask.segments, Segment(9, SOFA, True, 0.5)))
        views[at] = replace(views[at], mask=mask)
    found = match_views(views, THINGS, SEGMENTS, Matching())
    assert len(found) == 1
    assert found[0].class_id == CHAIR and len(found[0].masks) == 14 and found[0].views == 12


def unit_box(x: float) -> OrientedBox:
    return OrientedBox(np.array([x, 0.0, 0.0]), np.ones(3), 0.0)


@pytest.mark.parametrize(
    ("terms", "same", "half"), [("IoU+IoM", -1.5, -0.25 - 0.5), ("IoU", -0.5, -0.25), ("IoM", -1.0, -0.5)]
)
def test_matching_costs_of_boxes_match_their_formulas(terms: str, same: float, half: float) -> None:
    assert pair_cost(unit_box(0), unit_box(0), terms) == pytest.approx(same)
    assert pair_cost(unit_box(0), unit_box(0.5), terms) == pytest.approx(half)
    assert pair_cost(unit_box(0), unit_box(2), terms) == 0.0


def test_matching_rules_hybrid_and_literal_differ_when_the_best_match_is_taken() -> None:
    view = view_of("a", around(0), [LEFT, ((0.5, 0.0, 0.0), (1.0, 0.5, 0.8))])
    known = match_views([view], THINGS, SEGMENTS, Matching())
    half = local_instances(view, THINGS, SEGMENTS)[0]
    halves = [half, replace(half, masks=(ObjectMask(view.name, Segment(8, CHAIR, True), half.pixels),))]
    hybrid = update_instances(known, halves, 0.03, Matching(rule="hybrid"))
    literal = update_instances(known, halves, 0.03, Matching(rule="literal"))
    # The text forces the second half onto the far chair, its Hungarian partner.
    assert [len(item.masks) for item in hybrid] == [3, 1]
    assert [len(item.masks) for item in literal] == [2, 2]


def test_one_near_view_outvotes_three_far_ones_but_not_five() -> None:
    def seen(frame: str, class_id: int, pixels: int, segment: int = 1) -> ObjectMask:
        return ObjectMask(frame, Segment(segment, class_id, True, 0.9), pixels)

    near, far = seen("near", SOFA, 1600), [seen(f, CHAIR, 100) for f in "abcde"]
    assert class_by_views([near, *far[:3]]) == SOFA
    assert class_by_views([near, *far]) == CHAIR
    # Four pieces in one view have no more votes than one of their size.
    pieces = [seen("near", SOFA, 400, i) for i in range(4)]
    assert class_by_views([*pieces, *far]) == CHAIR
    assert class_by_views([seen("a", SOFA, 50), seen("b", CHAIR, 50)]) == CHAIR


def box(centre: tuple[float, float, float], size: tuple[float, float, float], yaw: float) -> OrientedBox:
    return OrientedBox(np.array(centre), np.array(size), yaw)


def inside(box: OrientedBox, points: np.ndarray) -> np.ndarray:
    cos, sin = math.cos(box.yaw), math.sin(box.yaw)
    local = (points - box.centre) @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return (np.abs(local) <= box.size / 2).all(1)


lengths = st.floats(0.2, 2.0)
boxes = st.builds(
    lambda x, y, z, a, b, c, yaw: box((x, y, z), (a, b, c), yaw),
    *[st.floats(-0.8, 0.8)] * 3, lengths, lengths, lengths, st.floats(-1.5, 1.5),
)  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(boxes, boxes)
def test_the_intersection_volume_of_boxes_agrees_with_monte_carlo(first: OrientedBox, second: OrientedBox) -> None:
    half = first.size / 2
    local = np.random.default_rng(0).uniform(-half, half, (20000, 3))
    cos, sin = math.cos(first.yaw), math.sin(first.yaw)
    points = local @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + first.centre
    share = inside(second, points).mean()
    expected = share * first.volume
    volume = intersection_volume(first, second)
    assert volume == pytest.approx(expected, abs=0.02 * first.volume)
    assert volume == pytest.approx(intersection_volume(second, first), abs=1e-9)
    assert -1e-12 <= volume <= min(first.volume, second.volume) + 1e-9
    assert intersection_volume(first, first) == pytest.approx(first.volume)


@settings(max_examples=40, deadline=None)
@given(boxes, st.integers(0, 1000))
def test_fitting_a_box_to_points_of_a_box_gives_that_box(original: OrientedBox, seed: int) -> None:
    points = np.concatenate([original.corners, original.centre[None]]) + [100.0, -50.0, 7.0]
    found = fit_box(np.random.default_rng(seed).permutation(points), 0.01)
    assert found.volume == pytest.approx(original.volume, rel=1e-3)
    np.testing.assert_allclose(found.centre, original.centre + [100.0, -50.0, 7.0], atol=1e-4)
    assert found.size[0] >= found.size[1] and -math.pi / 2 <= found.yaw < math.pi / 2
    moved = OrientedBox(found.centre, found.size + 1e-3, found.yaw)
    assert inside(moved, points).all()


def test_boxes_of_flat_objects_have_a_minimum_thickness() -> None:
    flat = fit_box(np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0]]), 0.05)
    np.testing.assert_allclose(flat.size, [2.0, 0.05, 0.05])
    assert flat.yaw == pytest.approx(0.0)
    with pytest.raises(ValueError, match="point"):
        fit_box(np.zeros((0, 3)), 0.05)
