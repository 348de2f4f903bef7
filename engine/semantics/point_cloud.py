"""Makes the robust semantic point cloud (paper, section "Robust Semantic Anchor Point Discovery"), and from it anchors
by voxelisation, with their labels (section "Structured Panoptic-Aware Scene Representation").

Pixels are unprojected by depth and clustered. Each cluster takes the label that most of its consistent pixels have.
Pixels without a consistent label still give geometry; else walls behind rejected edges would have no anchors."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..machine.distinct_rows import distinct_rows
from ..presets.preset import EvidenceKind
from ..scene import VOID, OnDemand, Progress, View, evidence, resolution_of
from .cloud_index import CloudIndex
from .clustering import lloyd_step, seed_centres

LLOYD_STEPS = 1
"""Steps of K-means after the seeding."""


@dataclass(frozen=True)
class CloudOptions:
    """``spacing``: the distance of clusters, metres (half the anchors' voxel size works well), enlarged until at most
    ``cap`` clusters are left. A cluster whose winning class has less than the share ``majority`` of the votes is
    unknown. ``evidence``: how many votes a view has on a cluster; the paper's choice is its "pixels". ``most_pixels``:
    about how many pixels of all views to use, by taking every s-th row and column."""

    spacing: float = 0.025
    cap: int = 200_000
    majority: float = 0.5
    evidence: EvidenceKind = "pixels"
    most_pixels: int | None = None


@dataclass(frozen=True, eq=False)
class SemanticPointCloud:
    """A point per cluster: ``xyz`` float32 [N, 3], world metres; ``rgb`` uint8 [N, 3]; ``class_id`` int32 [N], 0 =
    unknown; ``confidence`` float32 [N], the winning class's share of the votes, 0 without votes; ``votes`` float32 [N,
    C] for each of ``class_ids`` (C); ``spacing``, metres."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    class_id: NDArray[np.int32]
    confidence: NDArray[np.float32]
    votes: NDArray[np.float32]
    class_ids: tuple[int, ...]
    spacing: float

    def __len__(self) -> int:
        return len(self.xyz)

    def index(self) -> CloudIndex:
        """Return an index that finds the nearest point, labelled or not."""
        return CloudIndex(self.xyz)


def majority_vote(
    votes: NDArray[np.floating], class_ids: Sequence[int], majority: float
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the class id with the most votes in each row of ``votes`` [N, C], int32 [N], and its share, float32 [N].
    Ties go to the lower id. The id is 0 (unknown) without votes, or if its share is below ``majority``."""
    if not votes.shape[1]:
        return np.zeros(len(votes), np.int32), np.zeros(len(votes), np.float32)
    winner = votes.argmax(1)
    total = votes.sum(1)
    share = (votes[np.arange(len(votes)), winner] / np.maximum(total, 1e-12)).astype(np.float32)
    known = (total > 0) & (share >= majority)
    return np.where(known, np.asarray(class_ids, np.int32)[winner], VOID).astype(np.int32), share


def build_point_cloud(
    views: Sequence[View],
    keep: Iterable[NDArray[np.bool_]],
    class_ids: Sequence[int],
    options: CloudOptions,
    progress: Progress = lambda *_: None,
) -> SemanticPointCloud:
    """Cluster all pixels with depth. Labels of pixels in ``keep`` (bool [H, W] per view, in order) vote on the
    clusters' labels. Only one view at a time and the clusters are in memory. Raises ValueError without depth."""
    passes, done = 2 + LLOYD_STEPS, itertools.count(1)

    def read(view: View) -> NDArray[np.float64]:
        progress(next(done), passes * len(views))
        return _points(view, stride)

    # The step in rows and columns between the pixels that are used.
    stride, pixels = 1, sum(view.camera.width * view.camera.height for view in views)
    while options.most_pixels is not None and pixels / stride**2 > options.most_pixels:
        stride += 1
    batches = OnDemand(len(views), lambda number: read(views[number]))
    centres, spacing = seed_centres(batches, options.spacing, options.cap)
    for _ in range(LLOYD_STEPS):
        centres = lloyd_step(batches, centres, spacing)
    if not len(centres):
        raise ValueError("no view has a pixel with depth, so there is no point cloud")

    tally = _Tally(centres, spacing, np.asarray(class_ids), options.evidence)
    for view, consistent in zip(views, keep, strict=True):
        tally.add(view, consistent, stride)
        progress(next(done), passes * len(views))
    class_id, confidence = majority_vote(tally.votes, class_ids, options.majority)
    return SemanticPointCloud(
        centres.astype(np.float32), tally.colour, class_id, confidence, tally.votes, tuple(class_ids), spacing
    )


def _points(view: View, stride: int) -> NDArray[np.float64]:
    """Return every ``stride``-th pixel with depth, by row and column, as a world point: float64 [n, 3], metres."""
    depth = view.depth[::stride, ::stride]
    points: NDArray[np.float64] = view.camera.unproject(view.depth)[::stride, ::stride][depth > 0]
    return points


class _Tally:
    """Sums votes, float32 [K, C], and colours of the views' pixels at the clusters with these ``centres`` [K, 3]."""

    def __init__(
        self, centres: NDArray[np.float64], spacing: float, class_ids: NDArray[np.int64], kind: EvidenceKind
    ) -> None:
        self._index, self._spacing = CloudIndex(centres), spacing
        self._class_ids, self._kind = class_ids, kind
        self.votes = np.zeros((len(centres), len(class_ids)), np.float32)
        self._rgb, self._members = np.zeros((len(centres), 3)), np.zeros(len(centres))

    @property
    def colour(self) -> NDArray[np.uint8]:
        """Return the clusters' mean colours, uint8 [K, 3]."""
        return np.rint(self._rgb / np.maximum(self._members, 1)[:, None]).astype(np.uint8)

    def add(self, view: View, consistent: NDArray[np.bool_], stride: int) -> None:
        """Count every ``stride``-th pixel of a view, by row and column; only pixels in ``consistent`` [H, W] vote."""
        nearest = self._index.nearest(_points(view, stride), self._spacing)
        found = nearest >= 0
        valid = view.depth[::stride, ::stride] > 0
        label = view.mask.class_map()[::stride, ::stride][valid][found]
        cluster, column = nearest[found], np.minimum(np.searchsorted(self._class_ids, label), len(self._class_ids) - 1)
        colour = view.colour[::stride, ::stride][valid][found]
        pixels = np.bincount(cluster, minlength=len(self._members))
        self._members += pixels
        for channel in range(3):
            self._rgb[:, channel] += np.bincount(cluster, colour[:, channel], len(self._members))
        voting = consistent[::stride, ::stride][valid][found] & (self._class_ids[column] == label)
        classes = len(self._class_ids)
        cells, count = np.unique(cluster[voting] * classes + column[voting], return_counts=True)
        resolution = np.bincount(cluster, resolution_of(view)[::stride, ::stride][valid][found], len(pixels))
        whole = pixels * (stride * view.mask_scale) ** 2
        of_cluster = evidence(self._kind, whole, resolution / np.maximum(pixels, 1)) / np.maximum(pixels, 1)
        self.votes.reshape(-1)[cells] += count * of_cluster[cells // classes]


def voxelise(points: NDArray[np.floating], voxel_size: float) -> NDArray[np.float32]:
    """Return V = {[P / eps]} * eps of the paper: anchor positions float32 [M, 3], in lexical order, for points P [N, 3]
    and eps = ``voxel_size``, metres. [.] rounds half to even."""
    voxels, _ = _voxels(points, voxel_size)
    return (voxels * voxel_size).astype(np.float32)


def label_anchors(
    cloud: SemanticPointCloud, instance_of_point: NDArray[np.int32], anchor_xyz: NDArray[np.floating], voxel_size: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return each anchor's class, s_v of the paper, and instance, int32 [M] each, by a vote of the cloud's points in
    its voxel; 0 = unknown. Unknown points do not vote, and only points of the anchor's class vote on its instance. Ties
    go to the lower id. ``instance_of_point`` int32 [N], 0 = none."""
    both = np.concatenate([np.asarray(cloud.xyz, np.float64), np.asarray(anchor_xyz, np.float64)])
    voxels, voxel = _voxels(both, voxel_size)
    anchor_of_voxel = np.full(len(voxels), -1, np.int64)
    # Backwards, so that a voxel gets the first of several anchors.
    anchor_of_voxel[voxel[len(cloud) :][::-1]] = np.arange(len(anchor_xyz))[::-1]
    anchor = anchor_of_voxel[voxel[: len(cloud)]]
    class_id = _majority(anchor, cloud.class_id, len(anchor_xyz))
    agrees = (anchor >= 0) & (cloud.class_id == class_id[np.maximum(anchor, 0)])
    return class_id, _majority(np.where(agrees, anchor, -1), instance_of_point, len(anchor_xyz))


def _voxels(points: NDArray[np.floating], voxel_size: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the occupied voxels, float64 [M, 3], in lexical order, and the index of each point's voxel, int64 [N]."""
    rounded = np.rint(np.asarray(points, np.float64).reshape(-1, 3) / voxel_size)
    voxels, inverse = distinct_rows(rounded.astype(np.int64))
    return voxels.astype(np.float64), inverse


def _majority(group: NDArray[np.int64], label: NDArray[np.int32], groups: int) -> NDArray[np.int32]:
    """Return the most frequent label > 0 of each group's members, int32 [groups]; ``group`` -1: in no group."""
    voting = (group >= 0) & (label > VOID)
    ids, column = np.unique(label[voting], return_inverse=True)
    votes = np.bincount(group[voting] * len(ids) + column.reshape(-1), minlength=groups * len(ids))
    return majority_vote(votes.reshape(groups, len(ids)).astype(np.float64), ids.tolist(), 0.0)[0]
