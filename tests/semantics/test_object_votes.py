from __future__ import annotations

import numpy as np

from engine.semantics import SemanticPointCloud, label_by_object, vote_classes
from tests.semantics.plane_views import CHAIR, CLASS_IDS, SOFA, WALL


def shown(rows: list[int], classes: list[int], pixels: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.array(rows, np.int32), np.array(classes, np.int32), np.array(pixels, np.int32)


OWNER = np.array([1, 1, 1, 2, 0], np.int32)


def test_each_view_has_the_square_root_of_its_pixels() -> None:
    near = shown([0, 1, 2, 3], [SOFA, SOFA, CHAIR, WALL], [60, 60, 40, 9])
    far = shown([0, 4], [CHAIR, CHAIR], [25, 999])
    votes = vote_classes([near, far], OWNER, CLASS_IDS)
    np.testing.assert_allclose(votes[0], 0)
    np.testing.assert_allclose(votes[1], [0, 0, 40 / np.sqrt(160) + 5, 120 / np.sqrt(160)])
    np.testing.assert_allclose(votes[2], [3, 0, 0, 0])


def test_void_and_unknown_classes_do_not_vote() -> None:
    votes = vote_classes([shown([0, 1], [0, 99], [10, 10])], OWNER, CLASS_IDS)
    assert not votes.any()


def cloud_of(class_id: list[int], votes: list[list[float]]) -> SemanticPointCloud:
    count = len(class_id)
    return SemanticPointCloud(
        np.zeros((count, 3), np.float32), np.zeros((count, 3), np.uint8), np.array(class_id, np.int32),
        np.full(count, 0.6, np.float32), np.array(votes, np.float32), CLASS_IDS, 0.1,
    )  # fmt: skip


def test_things_are_decided_as_a_whole_and_stuff_is_left_to_its_points() -> None:
    cloud = cloud_of([CHAIR, SOFA, 0, SOFA, CHAIR], [[0, 0, 5, 5]] * 2 + [[0, 0, 0, 0]] + [[0, 0, 5, 5]] * 2)
    votes = np.array([[0, 0, 0, 0], [0, 0, 1, 3], [5, 0, 0, 4]], np.float64)
    decided, owner = label_by_object(cloud, OWNER, votes, frozenset({CHAIR, SOFA}))
    assert decided.class_id.tolist() == [SOFA, SOFA, SOFA, SOFA, CHAIR]
    assert owner.tolist() == [1, 1, 1, 0, 0]
    np.testing.assert_allclose(decided.confidence, [0.75, 0.75, 0.75, 0.6, 0.6])


def test_a_point_that_no_view_calls_so_is_not_swept_into_an_object() -> None:
    cloud = cloud_of([CHAIR, CHAIR, SOFA, SOFA, CHAIR], [[0, 0, 10, 0], [0, 0, 8, 2], *[[0, 0, 0, 10]] * 3])
    votes = np.array([[0, 0, 0, 0], [0, 0, 1, 3], [5, 0, 0, 4]], np.float64)
    decided, owner = label_by_object(cloud, OWNER, votes, frozenset({CHAIR, SOFA}))
    assert decided.class_id.tolist()[:3] == [CHAIR, SOFA, SOFA]
    assert owner.tolist()[:3] == [0, 1, 1]
