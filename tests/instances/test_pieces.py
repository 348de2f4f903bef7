"""Objects cut into pieces and put together again by the views that see several of them."""

from __future__ import annotations

import numpy as np
import pytest

from engine.instances.agreement import ViewPoints
from engine.instances.objects import PieceRules, connected_pieces, regroup_pieces
from tests.instances.two_chairs import CHAIR, SOFA

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
    found, origin = regroup_pieces(xyz, object_of_point, classes, views, RULES)
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
def test_an_object_is_cut_where_no_view_or_few_join_its_pieces(views: list[ViewPoints], is_one: bool) -> None:
    expected = ([1, 1], [1]) if is_one else ([1, 2], [1, 1])
    assert regrouped(two_blocks(FAR), [1, 1], [CHAIR], views) == expected


def test_a_piece_in_between_joins_two_others() -> None:
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
def test_only_a_majority_of_views_joins_two_objects(
    x: float, classes: list[int], views: list[ViewPoints], is_one: bool
) -> None:
    expected = ([1, 1], [1]) if is_one else ([1, 2], [1, 2])
    assert regrouped(two_blocks(x), [1, 2], classes, views) == expected


def test_fragments_vanish() -> None:
    chair = np.random.default_rng(0).uniform(0, 0.4, (400, 3))
    fragment = chair[:10] + [3.0, 0.0, 0.0]  # enough points for a piece, but little of the chair
    few = chair[:4] + [0.0, 3.0, 0.0]
    xyz = np.concatenate([chair, fragment, few, [[9.0, 9.0, 9.0]]])
    owner = np.array([1] * 414 + [2], np.int32)
    everything = view((3, slice(0, 415)), points=415)
    found, origin = regroup_pieces(xyz, owner, [CHAIR, SOFA], [everything] * 3, RULES)
    assert (found[:400] == 1).all() and not found[400:414].any()
    assert found[414] == 0 and origin == [1], "a lone point is not an object"


def test_the_largest_piece_says_which_object_a_group_comes_from() -> None:
    xyz = np.concatenate([block(0.0, 10), block(NEAR, 30)])
    owner = np.repeat(np.array([1, 2], np.int32), [10, 30])
    all_of_it = view((3, slice(0, 40)), points=40)
    found, origin = regroup_pieces(xyz, owner, [SOFA, SOFA], [all_of_it] * 2, RULES)
    assert (found == 1).all() and origin == [2]


def test_without_objects_there_are_none() -> None:
    found, origin = regroup_pieces(two_blocks(FAR), np.zeros(2 * SIZE, np.int32), [], [together()], RULES)
    assert not found.any() and origin == []


def test_points_hang_together_within_reach() -> None:
    points = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.5, 0, 0], [0.2, 0.14, 0]])
    assert connected_pieces(points, 0.15).tolist() == [0, 0, 0, 1, 0]
    assert connected_pieces(points[:1], 0.15).tolist() == [0]
