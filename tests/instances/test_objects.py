"""Classes of objects, and objects cut into pieces and put together again by the views that see several of them."""

import numpy as np
import pytest

from engine.instances.agreement import ViewPoints
from engine.instances.objects import (
    PieceRules,
    held_back_agreement,
    object_classes,
    regroup_pieces,
    unowned_pieces,
    vote_classes,
)
from engine.presets.preset import ViewEvidence
from engine.scene import Camera, PanopticMask, Segment, View
from tests.semantics.plane_views import CHAIR, CLASS_IDS, SOFA, WALL


def showing(
    rows: list[int], classes: list[int], pixels: list[int], resolution: float = 1.0
) -> tuple[ViewPoints, np.ndarray]:
    row, count = np.array(rows, np.int32), np.array(pixels, np.float32)
    return ViewPoints(row, row, count, np.full(len(row), resolution, np.float32)), np.array(classes, np.int32)


OWNER = np.array([1, 1, 1, 2, 0], np.int32)


def test_a_views_vote_on_an_objects_class_grows_with_root_of_pixels() -> None:
    near = showing([0, 1, 2, 3], [SOFA, SOFA, CHAIR, WALL], [60, 60, 40, 9])
    far = showing([0, 4], [CHAIR, CHAIR], [25, 999])
    votes = vote_classes([near, far], OWNER, 2, CLASS_IDS, "root")
    np.testing.assert_allclose(votes[0], 0)
    np.testing.assert_allclose(votes[1], [0, 0, 40 / np.sqrt(160) + 5, 120 / np.sqrt(160)])
    np.testing.assert_allclose(votes[2], [3, 0, 0, 0])


def test_one_sharp_view_outvotes_many_views_that_barely_resolve_the_object() -> None:
    near = showing([0, 1], [SOFA, SOFA], [60, 60], resolution=4.0)
    far = [showing([0, 1], [CHAIR, CHAIR], [4, 4], resolution=1.0)] * 12
    for kind, expected in (("views", CHAIR), ("pixels", SOFA), ("density", SOFA)):
        votes = vote_classes([near, *far], OWNER, 2, CLASS_IDS, kind)
        assert object_classes(votes, CLASS_IDS, np.zeros(len(votes), bool))[1] == expected, kind


def test_pixels_of_void_or_unknown_class_do_not_vote_on_an_objects_class() -> None:
    votes = vote_classes([showing([0, 1], [0, 99], [10, 10])], OWNER, 2, CLASS_IDS, "root")
    assert not votes.any()


def test_an_object_has_the_class_with_most_votes() -> None:
    votes = np.array([[0, 0, 0, 0], [0, 0, 1, 3], [5, 0, 0, 5], [0, 0, 0, 0]], np.float64)
    classes = object_classes(votes, CLASS_IDS, np.zeros(len(votes), bool))
    assert classes.tolist() == [0, SOFA, WALL, 0], "ties go to the lower class, without votes there is none"


def test_an_object_on_whose_class_views_disagree_has_no_class() -> None:
    votes = np.array([[0, 0, 0, 0], [3, 2, 2, 3.2], [2, 2, 2, 4]], np.float64)
    assert object_classes(votes, CLASS_IDS, np.array([False, False, False])).tolist() == [0, 0, SOFA]
    assert object_classes(votes, CLASS_IDS, np.array([False, True, False])).tolist() == [0, SOFA, SOFA]


def test_held_out_views_reveal_two_objects_joined_into_one() -> None:
    """Points 0 to 3 are object 1. Where each view calls all of it one thing, a view agrees with the others' class as
    often as with their points; where its halves are two things in every view, it agrees with their points alone."""
    one = [showing([0, 1, 2, 3], [kind] * 4, [10] * 4) for kind in (SOFA, SOFA, CHAIR, WALL, SOFA)]
    halves = [showing([0, 1, 2, 3], [SOFA, SOFA, CHAIR, CHAIR], [10] * 4) for _ in range(5)]
    owner, kinds = np.array([1, 1, 1, 1, 0], np.int32), ViewEvidence()
    assert held_back_agreement(one, owner, 1, CLASS_IDS, kinds=kinds, frames=[[n] for n in range(len(one))]).tolist()[1]
    assert not held_back_agreement(
        halves, owner, 1, CLASS_IDS, kinds=kinds, frames=[[n] for n in range(len(halves))]
    ).tolist()[1]


RULES = PieceRules(reach=0.15)
SIZE = 20
"""Points of each block."""


def block(x: float, points: int = SIZE) -> np.ndarray:
    """Points 10 cm apart along y at ``x`` metres."""
    return np.column_stack([np.full(points, x), 0.1 * np.arange(points), np.zeros(points)])


def view(*segments: tuple[int, slice | np.ndarray], points: int) -> ViewPoints:
    """A view that shows the rows of each segment."""
    shown = np.full(points, -1, np.int32)
    for segment, rows in segments:
        shown[rows] = segment
    row = np.flatnonzero(shown >= 0).astype(np.int32)
    return ViewPoints(row, shown[row], np.ones(len(row), np.float32), np.ones(len(row), np.float32))


FAR, NEAR = 3.0, 0.1
FIRST, SECOND = slice(0, SIZE), slice(SIZE, 2 * SIZE)


def two_blocks(x: float) -> np.ndarray:
    return np.concatenate([block(0.0), block(x)])


def together() -> ViewPoints:
    return view((3, slice(0, 2 * SIZE)), points=2 * SIZE)


def apart() -> ViewPoints:
    return view((3, FIRST), (4, SECOND), points=2 * SIZE)


def only(part: slice) -> ViewPoints:
    return view((3, part), points=2 * SIZE)


def regrouped(
    xyz: np.ndarray, owner: list[int], classes: list[int], views: list[ViewPoints]
) -> tuple[list[int], list[int]]:
    """The object of each block's points, and where the objects come from."""
    object_of_point = np.repeat(np.array(owner, np.int32), SIZE)
    found, origin = regroup_pieces(xyz, object_of_point, classes, views, rules=RULES)
    assert found.dtype == np.int32
    blocks = found.reshape(-1, SIZE)
    assert (blocks == blocks[:, :1]).all()
    return blocks[:, 0].tolist(), origin


VOID = view((0, slice(0, 2 * SIZE)), points=2 * SIZE)


@pytest.mark.parametrize(
    ("views", "is_one"),
    [
        ([only(FIRST), only(SECOND)] * 3, False),
        ([apart()] * 4 + [together()], False),
        ([together()] * 2 + [apart()], True),
    ],
    ids=["no view joins them", "most views tell them apart", "the legs of a table"],
)
def test_an_object_is_cut_where_too_few_views_join_its_pieces(views: list[ViewPoints], is_one: bool) -> None:
    expected = ([1, 1], [1]) if is_one else ([1, 2], [1, 1])
    assert regrouped(two_blocks(FAR), [1, 1], [CHAIR], views) == expected


def test_two_pieces_are_one_object_if_views_join_both_to_a_third() -> None:
    xyz = np.concatenate([block(0.0), block(FAR), block(2 * FAR)])
    points = 3 * SIZE
    left = view((3, slice(0, 2 * SIZE)), points=points)
    right = view((8, slice(SIZE, 3 * SIZE)), points=points)
    assert regrouped(xyz, [1, 1, 1], [CHAIR], [left, right]) == ([1, 1, 1], [1])
    assert regrouped(xyz, [1, 1, 1], [CHAIR], [left, left]) == ([1, 1, 2], [1, 1])


@pytest.mark.parametrize(
    ("x", "classes", "views", "is_one"),
    [
        (NEAR, [SOFA, SOFA], [only(FIRST)] * 5 + [only(SECOND)] * 5 + [together()] * 2, True),
        (NEAR, [SOFA, SOFA], [together()] * 2 + [VOID] * 9, True),
        (NEAR, [SOFA, SOFA], [together(), apart(), apart()], False),
        (NEAR, [SOFA, SOFA], [together(), only(FIRST), only(SECOND)], False),
        (NEAR, [SOFA, CHAIR], [together()] * 4, False),
        (FAR, [SOFA, SOFA], [together()] * 4, False),
    ],
    ids=["seen from both ends", "void does not judge", "told apart", "one view", "two classes", "do not touch"],
)
def test_only_a_majority_joins_two_objects(x: float, classes: list[int], views: list[ViewPoints], is_one: bool) -> None:
    expected = ([1, 1], [1]) if is_one else ([1, 2], [1, 2])
    assert regrouped(two_blocks(x), [1, 2], classes, views) == expected


def test_small_fragments_far_from_an_object_are_dropped() -> None:
    chair = np.random.default_rng(0).uniform(0, 0.4, (400, 3))
    fragment = chair[:10] + [3.0, 0.0, 0.0]  # enough points for a piece, but little of the chair
    few = chair[:4] + [0.0, 3.0, 0.0]
    xyz = np.concatenate([chair, fragment, few, [[9.0, 9.0, 9.0]]])
    owner = np.array([1] * 414 + [2], np.int32)
    everything = view((3, slice(0, 415)), points=415)
    found, origin = regroup_pieces(xyz, owner, [CHAIR, SOFA], [everything] * 3, rules=RULES)
    assert (found[:400] == 1).all() and not found[400:414].any()
    assert found[414] == 0 and origin == [1], "a lone point is not an object"


def test_regrouped_pieces_take_the_object_of_their_largest_piece() -> None:
    xyz = np.concatenate([block(0.0, 10), block(NEAR, 30)])
    owner = np.repeat(np.array([1, 2], np.int32), [10, 30])
    all_of_it = view((3, slice(0, 40)), points=40)
    found, origin = regroup_pieces(xyz, owner, [SOFA, SOFA], [all_of_it] * 2, rules=RULES)
    assert (found == 1).all() and origin == [2]


def test_unassigned_pieces_with_masks_in_two_views_become_objects() -> None:
    xyz = np.concatenate([block(0.0), block(2.0), block(4.0), block(6.0)])
    class_of_point = np.repeat(np.array([CHAIR, CHAIR, SOFA, CHAIR], np.int32), SIZE)
    ids = np.repeat(np.arange(1, 5), SIZE)
    segments = tuple(Segment(n, CHAIR, True) for n in (1, 2, 3, 4))  # nobody calls the third block a sofa
    seen = [view(*((n, ids == n) for n in shown), points=len(xyz)) for shown in ((1, 2, 3, 4), (1, 3, 4), (1, 3, 4))]
    camera, nothing = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4)), np.zeros((1, 1, 3), np.uint8)
    mask = PanopticMask(np.zeros((1, 1), np.int32), segments)
    views = [View(str(n), camera, nothing, np.zeros((1, 1), np.float32), mask) for n in range(3)]
    taken = {(str(n), 4) for n in range(3)}  # the masks of the fourth block are those of another object
    owner, found = unowned_pieces(xyz, class_of_point, views, seen, taken=taken, rules=PieceRules())
    assert owner.tolist() == [1] * SIZE + [0] * 3 * SIZE
    assert [(one.id, one.class_id, one.views) for one in found] == [(1, CHAIR, 3)]
