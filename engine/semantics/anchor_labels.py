"""Anchors by voxelisation, and the label of each (paper, section "Structured Panoptic-Aware Scene Representation")."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..machine.distinct_rows import distinct_rows
from ..scene import VOID
from .point_cloud import SemanticPointCloud, majority_vote


def voxelise(points: NDArray[np.floating], voxel_size: float) -> NDArray[np.float32]:
    """V = {[P / eps]} * eps: points [N, 3] and eps in metres to anchor positions float32 [M, 3], in lexical order.

    [.] rounds half to even.
    """
    voxels, _ = _voxels(points, voxel_size)
    return (voxels * voxel_size).astype(np.float32)


def label_anchors(
    cloud: SemanticPointCloud,
    instance_of_point: NDArray[np.int32],
    anchor_xyz: NDArray[np.floating],
    voxel_size: float,
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """s_v: class and instance of each anchor, int32 [M] each, by the majority of the cloud's points in its voxel.

    Unknown points (0) do not vote. An anchor without votes gets 0, and ties go to the lower id. ``instance_of_point``
    int32 [N]: an anchor takes its instance from the points that carry its class.
    """
    voxel_of_point, anchor_of_voxel = _shared_voxels(cloud.xyz, anchor_xyz, voxel_size)
    anchor = anchor_of_voxel[voxel_of_point]
    class_id = _majority(anchor, cloud.class_id, len(anchor_xyz))
    agrees = (anchor >= 0) & (cloud.class_id == class_id[np.maximum(anchor, 0)])
    return class_id, _majority(np.where(agrees, anchor, -1), instance_of_point, len(anchor_xyz))


def _voxels(points: NDArray[np.floating], voxel_size: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Distinct voxels float64 [M, 3] in lexical order, and the voxel of each point int64 [N]."""
    rounded = np.rint(np.asarray(points, np.float64).reshape(-1, 3) / voxel_size)
    voxels, inverse = distinct_rows(rounded.astype(np.int64))
    return voxels.astype(np.float64), inverse


def _shared_voxels(
    points: NDArray[np.floating], anchors: NDArray[np.floating], voxel_size: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Voxel of each point [N] and the anchor of each voxel (-1 where none; the first of several)."""
    both = np.concatenate([np.asarray(points, np.float64), np.asarray(anchors, np.float64)])
    voxels, inverse = _voxels(both, voxel_size)
    anchor_of_voxel = np.full(len(voxels), -1, np.int64)
    anchor_of_voxel[inverse[len(points) :][::-1]] = np.arange(len(anchors))[::-1]
    return inverse[: len(points)], anchor_of_voxel


def _majority(group: NDArray[np.int64], label: NDArray[np.int32], groups: int) -> NDArray[np.int32]:
    """Most frequent label > 0 of the members of each group (-1 = in none), int32 [groups]."""
    voting = (group >= 0) & (label > VOID)
    ids, column = np.unique(label[voting], return_inverse=True)
    votes = np.bincount(group[voting] * len(ids) + column.reshape(-1), minlength=groups * len(ids))
    return majority_vote(votes.reshape(groups, len(ids)).astype(np.float64), ids.tolist(), 0.0)[0]
