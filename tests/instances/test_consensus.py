"""Masks of views joined into objects, by all views or by the keyframes of a long scan."""

import tracemalloc
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from engine.instances import consensus
from engine.instances.agreement import Agreement, MasksInSpace, ViewsOnCloud, shown_classes, view_points
from engine.instances.records import ObjectMask
from engine.scene import Camera, PanopticMask, Segment, View
from tests.instances.two_chairs import CHAIR, SOFA, WALL

POINTS = 60
LEFT, RIGHT, BACK, SPOT = slice(0, 10), slice(10, 20), slice(20, 60), slice(40, 50)
OPTIONS = consensus.ConsensusOptions()


def strip(name: str, ids: np.ndarray, classes: dict[int, int], groups: Sequence[int] = ()) -> View:
    """A view that shows point i in the three pixels of column i: no geometry, only outlines."""
    camera = Camera(POINTS, 3, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    segments = tuple(Segment(i, c, c >= CHAIR and i not in groups, 0.8, i in groups) for i, c in classes.items())
    picture = np.repeat(ids[None].astype(np.int32), 3, 0)
    shape = picture.shape
    return View(
        name, camera, np.zeros((*shape, 3), np.uint8), np.ones(shape, np.float32), PanopticMask(picture, segments)
    )


def seeing(views: Sequence[View]) -> ViewsOnCloud:
    return ViewsOnCloud.of(views, [np.repeat(np.arange(POINTS, dtype=np.int32)[None], 3, 0)] * len(views))


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


def swallowed(name: str) -> View:
    """The left chair is drawn as wall: it has no outline of its own."""
    ids = np.full(POINTS, 7)
    ids[RIGHT] = 4
    return strip(name, ids, {4: CHAIR, 7: WALL})


def invented(name: str) -> View:
    """A chair where there is only wall."""
    ids = np.full(POINTS, 7)
    ids[LEFT], ids[RIGHT], ids[SPOT] = 3, 4, 5
    return strip(name, ids, {3: CHAIR, 4: CHAIR, 5: CHAIR, 7: WALL})


def blind(name: str) -> View:
    """All void: it sees every point and says nothing."""
    return strip(name, np.zeros(POINTS), {})


def objects_in(views: Sequence[View], options: consensus.ConsensusOptions = OPTIONS) -> consensus.FoundObjects:
    return consensus.find_objects(seeing(views), POINTS, options)


def owners(objects: consensus.FoundObjects, *parts: slice) -> list[int]:
    """The one object that each part's points belong to."""
    found = [np.unique(objects.object_of_point[part]) for part in parts]
    assert [len(each) for each in found] == [1] * len(parts)
    return [int(each[0]) for each in found]


def frames_of(objects: consensus.FoundObjects, number: int) -> set[str]:
    return {mask.frame for mask in objects.objects[number - 1].masks}


def test_views_that_merge_split_or_misname_objects_are_outvoted() -> None:
    views = [good("a"), merged("b"), good("c", left=SOFA), split("d"), good("e"), good("f", left=WALL)]
    objects = objects_in(views)
    left, right, back = owners(objects, LEFT, RIGHT, BACK)
    assert len({left, right, back}) == 3
    assert frames_of(objects, left) == {"a", "c", "d", "e", "f"}


def test_views_with_one_mask_for_two_chairs_do_not_vote_on_them() -> None:
    views = [*(good(name) for name in "abcdef"), *(merged(name) for name in "ghij")]
    objects = objects_in(views)
    left, right, back = owners(objects, LEFT, RIGHT, BACK)
    assert len({left, right, back}) == 3
    assert frames_of(objects, left) == frames_of(objects, right) == set("abcdef")
    # The merging views do not judge what belongs together, so nobody is against.
    assert {mask.agreement for mask in objects.objects[left - 1].masks} == {1.0}
    assert frames_of(objects, back) == set("abcdefghij")


SWALLOWED = [*(good(name) for name in "abcdef"), *(swallowed(name) for name in "ghij")]


def inventing(*names: str) -> list[View]:
    return [invented(name) if name in names else good(name) for name in "abcdefghij"]


@pytest.mark.parametrize(
    ("views", "showing_left"),
    [(SWALLOWED, "abcdef"), (inventing("a"), "abcdefghij"), (inventing(*"adg"), "abcdefghij")],
    ids=["some draw a chair as wall", "one sees a chair in the wall", "three see a chair in the wall"],
)
def test_chairs_are_kept_apart_from_the_wall_and_none_is_invented(views: list[View], showing_left: str) -> None:
    objects = objects_in(views)
    left, right, back = owners(objects, LEFT, RIGHT, BACK)
    assert len({left, right, back}) == len(objects.objects) == 3
    assert frames_of(objects, left) == set(showing_left) and frames_of(objects, right) == set("abcdefghij")
    assert all(mask.segment.class_id == CHAIR for mask in objects.objects[left - 1].masks)


def test_a_masks_agreement_is_the_share_of_views_that_confirm_its_object() -> None:
    # Of the six views d splits the left chair; b, which merges it with the right one, abstains.
    views = [good("a"), merged("b"), good("c"), split("d"), good("e"), good("f")]
    objects = objects_in(views)
    left = objects.objects[owners(objects, LEFT)[0] - 1].masks
    assert [(mask.frame, mask.agreement) for mask in left] == [(frame, 4 / 5) for frame in "acddef"]
    assert consensus.agreements(np.array([[9.0, 4.0], [4.0, 9.0]]), np.array([[9.0, 5.0], [5.0, 9.0]])) == [0.8, 0.8]
    assert consensus.agreements(np.ones((1, 1)), np.ones((1, 1))) == [None]


@pytest.mark.parametrize(("cutting", "found"), [("c", 1), ("cd", 0)])
def test_two_masks_become_an_object_only_if_most_other_views_agree(cutting: str, found: int) -> None:
    """Two views draw a thing. Each of the others sees seven of its 16 points, and draws them as parts of two others."""
    whole, cut = np.full(POINTS, 7), np.full(POINTS, 7)
    whole[40:56], cut[34:44], cut[44:60] = 5, 5, 6
    views = [strip(name, whole, {5: CHAIR, 7: WALL}) for name in "ab"]
    views += [strip(name, cut, {5: CHAIR, 6: CHAIR, 7: WALL}) for name in cutting]
    rows = np.repeat(np.arange(POINTS, dtype=np.int32)[None], 3, 0)
    partial = rows.copy()
    partial[:, 47:56] = -1
    objects = consensus.find_objects(ViewsOnCloud.of(views, [rows] * 2 + [partial] * len(cutting)), POINTS, OPTIONS)
    names = [[(mask.frame, mask.segment.id) for mask in one.masks] for one in objects.objects]
    assert names.count([("a", 5), ("b", 5)]) == found, "two of three views agree, but two of four do not"


def test_a_view_without_masks_of_an_object_does_not_vote_against_it() -> None:
    missing = good("b")
    ids = missing.mask.ids.copy()
    ids[:, LEFT] = 0
    missing = replace(missing, mask=PanopticMask(ids, missing.mask.segments[1:]))
    objects = objects_in([good("a"), missing, good("c"), good("d")])
    assert len(objects.objects) == 3 and (objects.object_of_point[LEFT] > 0).all()


def test_a_mask_that_may_be_several_objects_starts_no_object() -> None:
    ids = np.full(POINTS, 7)
    ids[LEFT], ids[RIGHT] = 3, 3
    views = [strip(name, ids, {3: CHAIR, 7: WALL}, groups=[3]) for name in "abcd"]
    objects = objects_in(views)
    assert len(objects.objects) == 1 and not objects.object_of_point[:20].any()
    # Where other views tell the chairs apart, the group does not join them.
    objects = objects_in([*views, *(good(name) for name in "efgh")])
    left, right = owners(objects, LEFT, RIGHT)
    assert left != right and frames_of(objects, left) == set("efgh")


@pytest.mark.parametrize(
    ("showing", "blinded", "least", "is_found"),
    [
        (2, 0, 3, True), (2, 1, 3, True), (2, 2, 3, False), (3, 2, 3, True),  # few views see it: two or three masks
        (3, 37, 3, False), (4, 36, 3, True),  # many do: masks in a share of them
        (1, 0, 3, False), (1, 0, 1, True), (0, 1, 3, False),
    ],
)  # fmt: skip
def test_an_object_needs_masks_in_enough_views(showing: int, blinded: int, least: int, is_found: bool) -> None:
    views = [*(good(f"good {i}") for i in range(showing)), *(blind(f"blind {i}") for i in range(blinded))]
    objects = objects_in(views, replace(OPTIONS, min_masks=least))
    assert len(objects.objects) == (3 if is_found else 0) and bool(objects.object_of_point.any()) is is_found


def test_a_points_segment_is_that_of_most_of_its_inner_pixels() -> None:
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
def test_fast_clustering_of_masks_matches_a_plain_greedy_algorithm(seed: int, count: int) -> None:
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
    cluster = consensus.join(weight)
    assert {tuple(np.flatnonzero(cluster == name)) for name in np.unique(cluster)} == expected
    assert all(cluster[name] == name for name in np.unique(cluster))


def with_tracks(view: View, tracks: dict[int, int]) -> View:
    """The same view, of whose masks a tracker followed some."""
    segments = tuple(replace(one, track=tracks.get(one.id)) for one in view.mask.segments)
    return replace(view, mask=replace(view.mask, segments=segments))


def test_a_tracker_joins_two_ends_of_a_sofa_that_no_view_shows_together() -> None:
    """The two ends of a sofa, each seen by three views of their own: only the tracker knows that they are one."""

    def end(name: str, part: slice) -> View:
        ids = np.zeros(POINTS)
        ids[part] = 3
        return strip(name, ids, {3: SOFA})

    ends = [end(f"left{i}", LEFT) for i in range(3)] + [end(f"right{i}", RIGHT) for i in range(3)]
    assert owners(objects_in(ends), LEFT, RIGHT) == [1, 2]
    assert owners(objects_in([with_tracks(view, {3: 8}) for view in ends]), LEFT, RIGHT) == [1, 1]


def test_views_outvote_a_tracker_that_jumps_between_chairs() -> None:
    """The tracker jumps from one chair to the other, and five views see two chairs."""
    views = [with_tracks(good(f"{i}"), {3: 1, 4: 2} if i < 3 else {3: 2, 4: 1}) for i in range(5)]
    left, right = owners(objects_in(views), LEFT, RIGHT)
    assert left != right


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_clustering_masks_in_parts_matches_clustering_all_at_once(seed: int, has_tracks: bool) -> None:
    """Every mask lies inside few others; the whole array of masks by masks is what a short scan could afford."""
    random = np.random.default_rng(seed)
    masks, views = 40, 9
    inside = sparse.csr_matrix((random.random((masks, masks)) < 0.03).astype(np.float32) + np.eye(masks, dtype="f4"))
    judges = (random.random((masks, views)) < 0.6).astype(np.float32)
    judgement = Agreement(inside, judges, judges)
    tracks = random.integers(0, 12, masks).tolist() if has_tracks else [None] * masks
    segments = [ObjectMask("view", Segment(1, CHAIR, True, track=track if track else None)) for track in tracks]
    space = MasksInSpace(segments, random.integers(0, views, masks), np.ones(masks, bool), None, None, None)
    rows = np.flatnonzero(random.random(masks) < 0.8)
    at_once = consensus.join(consensus.join_weight(space, judgement, rows, OPTIONS))
    assert consensus.join_agreeing(space, judgement, rows, OPTIONS).tolist() == at_once.tolist()
    assert 1 < len(np.unique(at_once)) < len(rows)


def test_a_small_object_seen_only_from_near_is_not_joined_to_a_large_one() -> None:
    """Four near views draw a sink in a countertop, twelve far ones draw both as one."""

    def countertop(name: str, *, sink: bool) -> View:
        ids = np.full(POINTS, 7)
        ids[5:45] = 3
        if sink:
            ids[10:20] = 4
        return strip(name, ids, {3: CHAIR, 4: SOFA, 7: WALL} if sink else {3: CHAIR, 7: WALL})

    near = [countertop(f"near {number}", sink=True) for number in range(4)]
    far = [countertop(f"far {number}", sink=False) for number in range(12)]
    far = [replace(view, depth=np.full_like(view.depth, 4.0)) for view in far]
    apart = objects_in([*near, *far], replace(OPTIONS, evidence="density"))
    large, small = owners(apart, slice(20, 45), slice(10, 20))
    assert large != small and owners(apart, slice(5, 10)) == [large]
    assert frames_of(apart, small) == {view.name for view in near}
    joined = objects_in([*near, *far], replace(OPTIONS, evidence="views"))
    assert len(set(owners(joined, slice(20, 45), slice(10, 20)))) == 1


def test_masks_of_further_views_join_the_object_that_contains_them() -> None:
    """They join whatever their class is; what lies half in an object, may be several or is too small joins none."""
    objects = objects_in([good(name) for name in "abcd"])
    half = np.full(POINTS, 7)
    half[5:15], half[RIGHT.stop - 5 : RIGHT.stop], half[:2] = 3, 4, 5
    more = [good("e", left=SOFA), strip("f", half, {3: CHAIR, 4: CHAIR, 5: CHAIR, 7: WALL}), merged("g"), blind("h")]
    more.append(strip("i", more[0].mask.ids[0], {3: CHAIR, 4: CHAIR, 7: WALL}, groups=[4]))
    joined = consensus.with_masks_of(objects, seeing(more), OPTIONS.rules)
    np.testing.assert_array_equal(joined.object_of_point, objects.object_of_point)
    left, right, back = (int(objects.object_of_point[part.start]) for part in (LEFT, RIGHT, BACK))
    assert len({left, right, back}) == 3 and 0 not in (left, right, back)
    found = {
        number: [(mask.frame, mask.segment.id, mask.agreement) for mask in joined.objects[number - 1].masks[4:]]
        for number in (left, right, back)
    }
    assert found[left] == [("e", 3, None), ("i", 3, None)]
    assert found[right] == [("e", 4, None), ("f", 4, None)]
    assert [frame for frame, *_ in found[back]] == ["e", "f", "g", "i"]
    assert all(own.masks == more.masks[:4] for own, more in zip(objects.objects, joined.objects, strict=True))


def test_memory_for_many_objects_stays_below_a_table_of_objects_by_points() -> None:
    chairs, wide = 200, 50
    points = chairs * wide
    ids = 1 + np.arange(points) // wide
    picture = np.repeat(ids[None].astype(np.int32), 3, 0)
    segments = tuple(Segment(number, CHAIR, True, 0.8, False) for number in range(1, chairs + 1))
    camera = Camera(points, 3, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    colour, depth = np.zeros((*picture.shape, 3), np.uint8), np.ones(picture.shape, np.float32)
    views = [View(name, camera, colour, depth, PanopticMask(picture, segments)) for name in "abc"]
    shown = np.repeat(np.arange(points, dtype=np.int32)[None], 3, 0)
    tracemalloc.start()
    try:
        found = consensus.find_objects(ViewsOnCloud.of(views, [shown] * 3), points, OPTIONS)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(found.objects) == chairs and len(np.unique(found.object_of_point)) == chairs
    assert peak < 0.7 * chairs * points * 8, "a table of all objects and points has this size"


POINTS_A_COLUMN = 4
THING = 7
"""Columns of each segment, so that a view shows several."""


def rows_of_ones(columns: list[np.ndarray], width: int) -> sparse.csr_matrix:
    ends = np.cumsum([0, *map(len, columns)])
    return sparse.csr_matrix((np.ones(ends[-1], np.float32), np.concatenate(columns), ends), (len(columns), width))


def corridor(views: int, sight: int) -> MasksInSpace:
    """Views that pass a long wall with things on it: view v sees the columns v to v + sight - 1. Every other segment is
    a thing, those between are wall."""
    columns = np.repeat(np.arange(views + sight - 1), POINTS_A_COLUMN)
    thing = columns // THING
    masks, view_of_mask, held, seen = [], [], [], []
    for view in range(views):
        rows = np.arange(view * POINTS_A_COLUMN, (view + sight) * POINTS_A_COLUMN)
        seen.append(rows)
        for number in np.unique(thing[rows]).tolist():
            class_id = CHAIR if number % 2 else WALL
            masks.append(ObjectMask(f"{view:04d}", Segment(number + 1, class_id, class_id == CHAIR)))
            view_of_mask.append(view)
            held.append(rows[thing[rows] == number])
    is_thing = np.array([mask.segment.is_thing for mask in masks])
    sight = rows_of_ones(seen, len(columns))
    return MasksInSpace(masks, np.array(view_of_mask), is_thing, rows_of_ones(held, len(columns)), sight, weight=sight)


def sightings(space: MasksInSpace, views: np.ndarray) -> np.ndarray:
    return np.asarray(space.sight[views].sum(0)).reshape(-1)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 40))
def test_every_view_that_shows_new_surface_is_chosen_as_a_keyframe(seed: int, most_masks: int) -> None:
    random = np.random.default_rng(seed)
    views, points = 25, 80
    seen = [np.flatnonzero(random.random(points) < random.choice([0.0, 0.05, 0.3])) for _ in range(views)]
    sight = rows_of_ones([rows.astype(np.int32) for rows in seen], points)
    masks = [ObjectMask(str(view), Segment(1, WALL, False)) for view in range(views) for _ in range(2)]
    view_of_mask = np.repeat(np.arange(views), 2)
    space = MasksInSpace(masks, view_of_mask, np.zeros(50, bool), sight[view_of_mask], sight, weight=sight)
    chosen = consensus.choose_keyframes(space, most_masks)
    assert len(chosen) and (np.diff(chosen) > 0).all()
    lacking = sightings(space, chosen) < np.minimum(sightings(space, np.arange(views)), consensus.SIGHTINGS)
    for view in np.setdiff1d(np.arange(views), chosen):
        assert not len(seen[view]) or lacking[seen[view]].mean() <= consensus.WORTH_IT


@pytest.mark.parametrize(("views", "sight"), [(2000, 18), (600, 120)])
def test_objects_seen_in_few_or_in_many_views_are_found(views: int, sight: int) -> None:
    """Evenly chosen views of so few masks would see one of 18 twice at most; one of 120 has masks in few of them."""
    space = corridor(views, sight)
    options = consensus.ConsensusOptions(most_masks=views // 4)
    keyframes = consensus.choose_keyframes(space, options.most_masks)
    assert len(keyframes) < 0.4 * views
    objects = consensus.objects_of_masks(space.of_views(keyframes), options)
    thing = np.repeat(np.arange(views + sight - 1), POINTS_A_COLUMN) // THING
    inner = sightings(space, np.arange(views)) == sight
    owner = objects.object_of_point[inner]
    assert (owner > 0).all()
    pairs = np.unique(np.column_stack([thing[inner], owner]), axis=0)
    assert len(pairs) == len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])), "each thing is one object"
