from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.instances import ConsensusOptions, find_objects, object_instances, without_strays
from engine.instances.consensus import consents, join, shown_classes, view_points
from engine.scene import Camera, PanopticMask, Segment, View
from tests.instances.two_chairs import CHAIR, SOFA, WALL

POINTS = 60
LEFT, RIGHT, BACK = slice(0, 10), slice(10, 20), slice(20, 60)
OPTIONS = ConsensusOptions()


def strip(name: str, ids: np.ndarray, classes: dict[int, int]) -> View:
    """A view that shows point i in the three pixels of column i: no geometry, only outlines."""
    camera = Camera(POINTS, 3, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    segments = tuple(Segment(i, c, c >= CHAIR, 0.8) for i, c in classes.items())
    picture = np.repeat(ids[None].astype(np.int32), 3, 0)
    shape = picture.shape
    return View(
        name, camera, np.zeros((*shape, 3), np.uint8), np.ones(shape, np.float32), PanopticMask(picture, segments)
    )


def seen(view: View) -> np.ndarray:
    return np.repeat(np.arange(POINTS, dtype=np.int32)[None], 3, 0)


def good(name: str, left: int = CHAIR) -> View:
    ids = np.full(POINTS, 7)
    ids[LEFT], ids[RIGHT] = 3, 4
    return strip(name, ids, {3: left, 4: CHAIR, 7: WALL})


def merged(name: str) -> View:
    ids = np.full(POINTS, 1)
    ids[LEFT], ids[RIGHT] = 2, 2
    return strip(name, ids, {1: WALL, 2: CHAIR})


def split(name: str) -> View:
    ids = np.full(POINTS, 1)
    ids[LEFT], ids[RIGHT], ids[:5] = 2, 3, 4
    return strip(name, ids, {1: WALL, 2: CHAIR, 3: CHAIR, 4: SOFA})


def test_merging_splitting_and_misnaming_views_are_outvoted() -> None:
    views = [good("a"), merged("b"), good("c", left=SOFA), split("d"), good("e"), good("f", left=WALL)]
    objects, _ = find_objects(views, seen, POINTS, OPTIONS)
    owner = objects.object_of_point
    groups = [np.unique(owner[part]) for part in (LEFT, RIGHT, BACK)]
    assert [len(group) for group in groups] == [1, 1, 1] and len(np.unique(np.concatenate(groups))) == 3
    left = objects.masks[int(groups[0][0]) - 1]
    assert {mask.frame for mask in left} == {"a", "c", "d", "e", "f"}


def test_consent_says_how_many_views_put_a_mask_to_its_object() -> None:
    # Of the six views all but d, which splits the left chair, show any two of its masks inside one mask.
    views = [good("a"), merged("b"), good("c"), split("d"), good("e"), good("f")]
    objects, _ = find_objects(views, seen, POINTS, OPTIONS)
    left = objects.masks[int(objects.object_of_point[7]) - 1]
    assert [(mask.frame, mask.consent) for mask in left] == [(frame, 5 / 6) for frame in "acddef"]
    assert consents(np.array([[9.0, 4.0], [4.0, 9.0]]), np.array([[9.0, 5.0], [5.0, 9.0]])) == [0.8, 0.8]
    assert consents(np.ones((1, 1)), np.ones((1, 1))) == [None]


def test_a_view_that_missed_an_object_says_nothing_about_it() -> None:
    missing = good("b")
    ids = missing.mask.ids.copy()
    ids[:, LEFT] = 0
    missing = replace(missing, mask=PanopticMask(ids, missing.mask.segments[1:]))
    objects, _ = find_objects([good("a"), missing, good("c"), good("d")], seen, POINTS, OPTIONS)
    assert len(objects.masks) == 3 and (objects.object_of_point[LEFT] > 0).all()


def test_objects_of_too_few_masks_are_dropped() -> None:
    objects, _ = find_objects([good("a"), good("b")], seen, POINTS, OPTIONS)
    assert not objects.object_of_point.any() and objects.masks == ()
    assert len(find_objects([good("a")], seen, POINTS, replace(OPTIONS, min_masks=1))[0].masks) == 3


def test_views_without_masks_have_no_objects() -> None:
    empty = strip("a", np.zeros(POINTS), {})
    objects, summaries = find_objects([empty], seen, POINTS, OPTIONS)
    assert not objects.object_of_point.any() and len(summaries) == 1


def test_points_show_the_segment_of_most_of_their_inner_pixels() -> None:
    ids = np.array([[5, 5, 5, 5, 9, 9, 9, 9]] * 4, np.int32)
    camera = Camera(8, 4, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    mask = PanopticMask(ids, (Segment(5, CHAIR, True), Segment(9, WALL, False)))
    view = View("a", camera, np.zeros((4, 8, 3), np.uint8), np.ones((4, 8), np.float32), mask)
    # Point 2 has six pixels on the edge in segment 5 and two inside segment 9; point 8 is all edge.
    rows = np.full((4, 8), -1, np.int32)
    rows[0:4, 3] = 2
    rows[0:2, 2:3] = -1
    rows[2:4, 6] = 2
    rows[3, 4] = 8
    found = view_points(view, rows)
    assert found.row.tolist() == [2, 8] and found.segment.tolist() == [9, 9] and found.pixels.tolist() == [6, 1]
    assert shown_classes(view, found).tolist() == [WALL, WALL]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 12))
def test_joining_is_the_greedy_one(seed: int, count: int) -> None:
    half = np.random.default_rng(seed).integers(-4, 5, (count, count)).astype(np.float64)
    weight = half + half.T
    groups = [[i] for i in range(count)]
    while True:
        sums = [
            (-weight[np.ix_(a, b)].sum(), i, j) for i, a in enumerate(groups) for j, b in enumerate(groups) if i < j
        ]
        if not sums or min(sums)[0] >= 0:
            break
        _, i, j = min(sums)
        groups[i] += groups.pop(j)
    expected = {tuple(sorted(group)) for group in groups}
    cluster = join(weight)
    assert {tuple(np.flatnonzero(cluster == name)) for name in np.unique(cluster)} == expected
    assert all(cluster[name] == name for name in np.unique(cluster))


def test_things_become_instances_with_boxes() -> None:
    views = [good(name) for name in "abc"]
    objects, _ = find_objects(views, seen, POINTS, OPTIONS)
    xyz = np.zeros((POINTS, 3))
    xyz[:, 0] = np.arange(POINTS)
    owner = np.where(np.arange(POINTS) < 20, objects.object_of_point, 0).astype(np.int32)
    classes = np.full(len(objects.masks) + 1, CHAIR, np.int32)
    instances, of_point = object_instances(views, objects, xyz, classes, owner, 0.1)
    assert [item.id for item in instances] == [1, 2] and [item.class_id for item in instances] == [CHAIR, CHAIR]
    assert [item.views for item in instances] == [3, 3] and instances[0].evidence[0].pixels == 30
    assert instances[0].box.size[0] == pytest.approx(9.0)
    assert set(of_point[:20].tolist()) == {1, 2} and not of_point[20:].any()


def test_crumbs_on_the_wall_behind_leave_the_object() -> None:
    chair = np.random.default_rng(0).uniform(0, 0.4, (300, 3))
    crumbs = chair[:20] + [3.0, 0.0, 0.0]
    half = chair[:150] + [0.0, 2.0, 0.0]
    owner = np.array([1] * 300 + [1] * 20 + [1] * 150 + [2], np.int32)
    kept = without_strays(np.concatenate([chair, crumbs, half, [[9.0, 9.0, 9.0]]]), owner, reach=0.15)
    assert (kept[:300] == 1).all() and not kept[300:320].any()
    assert (kept[320:470] == 1).all(), "a piece that is large enough belongs to the object"
    assert kept[470] == 2, "a lone point is all there is of its object"
