"""A baseline without a lift: a majority vote in voxels over the input masks.

Every labelled pixel of the training views votes for its class in the 5 cm voxel it falls in. A test view is read back
with its own depth, which a lifted model is not given: this baseline needs depth everywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.metrics.report import PredictedView, Report
from engine.scene import Camera, ClassTable, Scene, load_view

VOXEL_VOTE = "voxel vote (with test depth)"
VOXEL_SIZE = 0.05
"""Metres."""
SMALLEST_OBJECT = 20
"""Voxels; 20 voxels of 5 cm are 0.05 m^2 of surface. Smaller fragments share instance 0. Otherwise each would count as
an invented object, and the baseline would look worse than it is."""
VOTING_WIDTH = 320
"""Pixels: largest width at which training views vote. A pixel is still far smaller than a voxel, and rooms take
seconds."""
MOST_VOTERS = 500
"""The most training views that vote, evenly spread: with these, every voxel has its votes."""

_BITS, _HALF = 21, 1 << 20  # three indices in an int64, and what makes them positive


class VoxelVote:
    """Collects the votes of view after view."""

    def __init__(self, classes: ClassTable) -> None:
        self.classes = classes
        self._votes: list[NDArray[np.int64]] = []

    def add(self, camera: Camera, depth: NDArray[np.float32], class_map: NDArray[np.int32]) -> None:
        """Add a training view's votes: depth float32 [H, W] metres (0 = none), class ids int32 [H, W] (0 abstains)."""
        voting = (depth > 0) & np.isin(class_map, self.classes.ids)
        voxels, voxel_of = np.unique(_pack(camera.unproject(depth)[voting]), return_inverse=True)
        classes = max(self.classes.ids) + 1
        pairs, votes = np.unique(voxel_of.reshape(-1) * classes + class_map[voting], return_counts=True)
        self._votes.append(np.column_stack([voxels[pairs // classes], pairs % classes, votes]))

    @property
    def is_empty(self) -> bool:
        """Whether nothing has voted yet."""
        return not any(len(votes) for votes in self._votes)

    def result(self) -> VoxelMap:
        """The winners; ties go to the lower class id. Raises ValueError when nothing has voted."""
        if self.is_empty:
            raise ValueError("no training view has a labelled pixel with depth")
        voxel, class_id, votes = np.concatenate(self._votes).T
        pairs, pair = np.unique(np.column_stack([voxel, class_id]), axis=0, return_inverse=True)
        total = np.bincount(pair.reshape(-1), votes)  # NumPy 2.0 gives `pair` a second axis
        order = np.lexsort((pairs[:, 1], -total, pairs[:, 0]))  # by the last key first
        voxels, first = np.unique(pairs[order, 0], return_index=True)
        winner = pairs[order[first], 1].astype(np.int32)
        return VoxelMap(voxels, winner, _objects(voxels, winner, self.classes.thing_ids))


@dataclass(frozen=True, eq=False)
class VoxelMap:
    """Occupied voxels: packed indices int64 [N], ascending; class ids and instance ids int32 [N].

    Masks give objects new names in every view, so ids cannot be voted on. An instance is a connected component (26
    neighbours) of voxels of one thing class."""

    voxels: NDArray[np.int64]
    class_id: NDArray[np.int32]
    instance_id: NDArray[np.int32]

    def look_up(self, camera: Camera, depth: NDArray[np.float32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Class and instance ids, int32 [H, W] each, of a view whose depth, float32 [H, W] metres, is known.

        A point in an empty voxel takes the nearest occupied voxel's labels, a pixel without depth those of
        the nearest pixel with depth, so that void is never predicted. Without any depth all is 0."""
        from scipy.ndimage import distance_transform_edt
        from scipy.spatial import cKDTree

        seen = depth > 0
        semantic, instance = np.zeros(depth.shape, np.int32), np.zeros(depth.shape, np.int32)
        if not seen.any():
            return semantic, instance
        points = camera.unproject(depth)[seen]
        wanted, back = np.unique(_pack(points), return_inverse=True)
        row = np.minimum(np.searchsorted(self.voxels, wanted), len(self.voxels) - 1)
        empty = self.voxels[row] != wanted
        if empty.any():
            row[empty] = cKDTree(_unpack(self.voxels)).query(_unpack(wanted[empty]))[1]
        semantic[seen], instance[seen] = self.class_id[row][back], self.instance_id[row][back]
        if not seen.all():
            y, x = distance_transform_edt(~seen, return_distances=False, return_indices=True)
            semantic, instance = semantic[y, x], instance[y, x]
        return semantic, instance


def add_voxel_vote(report: Report, scene: Scene) -> None:
    """Score the voxel vote on the held-out frames that have ground truth. Raises PlgsError for a bad file."""
    frames = [frame for frame in scene.test_frames if frame.read_ground_truth is not None]
    voxels = vote(scene) if frames else None
    if voxels is not None:
        for frame in frames:
            report.add(VOXEL_VOTE, frame, PredictedView(*voxels.look_up(frame.camera, frame.depth(frame.size))))


def vote(scene: Scene) -> VoxelMap | None:
    """The voxels that the training views vote on, or None when no pixel could vote. Raises PlgsError for a bad file."""
    votes = VoxelVote(scene.classes)
    frames = scene.train_frames
    for index in np.linspace(0, len(frames) - 1, min(len(frames), MOST_VOTERS)).round().astype(int):
        width, height = frames[index].size
        scale = min(1.0, VOTING_WIDTH / width)
        view = load_view(frames[index], (round(width * scale), max(1, round(height * scale))))
        votes.add(view.camera, view.depth, view.mask.class_map())
    return None if votes.is_empty else votes.result()


def _pack(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """World points [N, 3] metres to one int64 per voxel, in lexical order of the voxel's indices."""
    index = np.floor(points / VOXEL_SIZE).astype(np.int64) + _HALF
    return (index[:, 0] << 2 * _BITS) | (index[:, 1] << _BITS) | index[:, 2]


def _unpack(voxels: NDArray[np.int64]) -> NDArray[np.int64]:
    """The voxels' indices, int64 [N, 3]."""
    mask = (1 << _BITS) - 1
    return np.stack([voxels >> 2 * _BITS, voxels >> _BITS & mask, voxels & mask], axis=1) - _HALF


def _objects(voxels: NDArray[np.int64], class_id: NDArray[np.int32], things: frozenset[int]) -> NDArray[np.int32]:
    """Instance ids int32 [N]: 1.. by connected component of equal thing class, 0 for stuff and fragments."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    thing = np.isin(class_id, sorted(things))
    edges = []
    for dx, dy, dz in np.ndindex(3, 3, 3):
        step = ((dx - 1) << 2 * _BITS) + ((dy - 1) << _BITS) + (dz - 1)
        if step <= 0:
            continue  # the other half finds the same pairs
        row = np.minimum(np.searchsorted(voxels, voxels + step), len(voxels) - 1)
        joined = (voxels[row] == voxels + step) & (class_id[row] == class_id) & thing
        edges.append(np.stack([np.flatnonzero(joined), row[joined]]))
    start, end = np.concatenate(edges, axis=1)
    graph = coo_array((np.ones(len(start), np.int8), (start, end)), shape=(len(voxels), len(voxels)))
    _, component = connected_components(graph, directed=False)
    large = thing & (np.bincount(component)[component] >= SMALLEST_OBJECT)
    instance = np.zeros(len(voxels), np.int32)
    _, instance[large] = np.unique(component[large], return_inverse=True)
    instance[large] += 1
    return instance
