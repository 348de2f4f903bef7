"""Votes in voxels on a hand-made room: two boxes on a wall, seen straight on."""

import numpy as np
import pytest

from engine.scene import Camera, Category, ClassTable
from research.baselines.voxel_vote import VoxelVote

WALL, CHAIR = 1, 5
CLASSES = ClassTable((Category(WALL, "wall", False, (9, 9, 9)), Category(CHAIR, "chair", True, (200, 9, 9))))
CAMERA = Camera(80, 40, 80.0, 80.0, 40.0, 20.0, np.eye(4))
DEPTH = np.full((40, 80), 2.0, np.float32)


def _labels() -> np.ndarray:
    labels = np.full((40, 80), WALL, np.int32)
    labels[8:30, 5:30] = CHAIR
    labels[8:30, 45:75] = CHAIR
    return labels


def test_a_voxel_takes_the_majority_class() -> None:
    votes = VoxelVote(CLASSES)
    wrong = np.full_like(_labels(), WALL)
    for labels in (_labels(), wrong, _labels(), np.zeros_like(wrong)):
        votes.add(CAMERA, DEPTH, labels)
    semantic, _ = votes.result().look_up(CAMERA, DEPTH)
    assert (semantic == _labels()).mean() > 0.93  # a voxel is two pixels wide: only borders differ


def test_voxels_that_do_not_touch_are_two_instances() -> None:
    votes = VoxelVote(CLASSES)
    votes.add(CAMERA, DEPTH, _labels())
    semantic, instance = votes.result().look_up(CAMERA, DEPTH)
    assert set(np.unique(instance)) == {0, 1, 2}
    assert instance[20, 15] != instance[20, 60]
    assert not instance[semantic == WALL].any()


def test_the_voxel_vote_never_predicts_void() -> None:
    votes = VoxelVote(CLASSES)
    depth = DEPTH.copy()
    depth[:, 30:] = 0
    votes.add(CAMERA, depth, _labels())
    looked = DEPTH.copy()
    looked[:, 70:] = 0
    semantic, _ = votes.result().look_up(CAMERA, looked)
    assert (semantic > 0).all()
    nothing, _ = votes.result().look_up(CAMERA, np.zeros_like(DEPTH))
    assert not nothing.any()


def test_a_voxel_vote_without_views_is_refused() -> None:
    votes = VoxelVote(CLASSES)
    assert votes.is_empty
    votes.add(CAMERA, np.zeros_like(DEPTH), _labels())
    with pytest.raises(ValueError, match="no training view"):
        votes.result()
