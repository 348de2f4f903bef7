from __future__ import annotations

import numpy as np

from engine.instances.agreement import ViewPoints
from engine.instances.objects import object_classes, vote_classes
from tests.semantics.plane_views import CHAIR, CLASS_IDS, SOFA, WALL


def shown(
    rows: list[int], classes: list[int], pixels: list[int], resolution: float = 1.0
) -> tuple[ViewPoints, np.ndarray]:
    row, count = np.array(rows, np.int32), np.array(pixels, np.float32)
    return ViewPoints(row, row, count, np.full(len(row), resolution, np.float32)), np.array(classes, np.int32)


OWNER = np.array([1, 1, 1, 2, 0], np.int32)


def test_each_view_has_the_square_root_of_its_pixels() -> None:
    near = shown([0, 1, 2, 3], [SOFA, SOFA, CHAIR, WALL], [60, 60, 40, 9])
    far = shown([0, 4], [CHAIR, CHAIR], [25, 999])
    votes = vote_classes([near, far], OWNER, 2, CLASS_IDS, "root")
    np.testing.assert_allclose(votes[0], 0)
    np.testing.assert_allclose(votes[1], [0, 0, 40 / np.sqrt(160) + 5, 120 / np.sqrt(160)])
    np.testing.assert_allclose(votes[2], [3, 0, 0, 0])


def test_a_view_that_resolves_the_object_outvotes_many_that_do_not() -> None:
    near = shown([0, 1], [SOFA, SOFA], [60, 60], resolution=4.0)
    far = [shown([0, 1], [CHAIR, CHAIR], [4, 4], resolution=1.0)] * 12
    for kind, expected in (("views", CHAIR), ("pixels", SOFA), ("density", SOFA)):
        votes = vote_classes([near, *far], OWNER, 2, CLASS_IDS, kind)
        assert object_classes(votes, CLASS_IDS)[1] == expected, kind


def test_void_and_unknown_classes_do_not_vote() -> None:
    votes = vote_classes([shown([0, 1], [0, 99], [10, 10])], OWNER, 2, CLASS_IDS, "root")
    assert not votes.any()


def test_the_class_with_most_votes_is_the_objects() -> None:
    votes = np.array([[0, 0, 0, 0], [0, 0, 1, 3], [5, 0, 0, 5], [0, 0, 0, 0]], np.float64)
    classes = object_classes(votes, CLASS_IDS)
    assert classes.tolist() == [0, SOFA, WALL, 0], "ties go to the lower class, without votes there is none"


def test_an_object_whose_views_name_many_classes_has_none() -> None:
    votes = np.array([[0, 0, 0, 0], [3, 2, 2, 3.2], [2, 2, 2, 4]], np.float64)
    assert object_classes(votes, CLASS_IDS).tolist() == [0, 0, SOFA]
