"""Finds the nearest point of a cloud, and projects a labelled cloud to a view (paper, section "Reliable Anchor Point
Regularization").

Projected masks supervise newly grown Gaussians before self-training, and give the consistent instance masks M_match.
The paper gives no splat size, and does not treat occlusion and holes. Here each pixel takes the label of the point
nearest to its surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..machine.threads import worker_count
from ..scene import Camera


class CloudIndex:
    """A k-d tree of points, float [N, 3], world metres."""

    def __init__(self, points: NDArray[np.floating]) -> None:
        self._tree = cKDTree(np.asarray(points, np.float64).reshape(-1, 3))

    def nearest(self, queries: NDArray[np.floating], reach: float) -> NDArray[np.int32]:
        """Return the index of the nearest point within ``reach`` metres of each query [..., 3], int32 [...], -1 = none.
        If two points are equally near, the lower index is taken; if more are, always the same one."""
        flat = np.asarray(queries, np.float64).reshape(-1, 3)
        found = np.full(len(flat), -1, np.int32)
        usable = np.isfinite(flat).all(axis=1)
        limit = np.nextafter(reach, np.inf)  # the tree's own bound is exclusive
        distance, row = self._tree.query(flat[usable], k=2, distance_upper_bound=limit, workers=worker_count())
        nearest = np.where(distance[:, 0] == distance[:, 1], row.min(axis=1), row[:, 0])
        found[usable] = np.where(np.isfinite(distance[:, 0]), nearest, -1)
        return found.reshape(queries.shape[:-1])

    def nearest_of_pixels(self, camera: Camera, depth: NDArray[np.float32], reach: float) -> NDArray[np.int32]:
        """Return the index of the point nearest to each pixel's surface, within ``reach``, int32 [H, W], -1 = none;
        ``depth`` [H, W], metres."""
        valid = depth > 0
        found = np.full(depth.shape, -1, np.int32)
        found[valid] = self.nearest(camera.unproject(depth)[valid], reach)
        return found


class LabelledPoints:
    """The points ``xyz`` float [N, 3], world metres, whose ``labels`` int32 [N] are not 0, in a k-d tree."""

    def __init__(self, xyz: NDArray[np.floating], labels: NDArray[np.int32]) -> None:
        known = labels != 0
        self._index = CloudIndex(xyz[known])
        self._label = np.append(labels[known], 0).astype(np.int32)  # the last is that of row -1, no point

    def project(self, camera: Camera, depth: NDArray[np.float32], reach: float) -> NDArray[np.int32]:
        """Return the label of the point nearest to each pixel's surface, int32 [H, W]; 0 (no supervision) if none is
        within ``reach`` metres (twice the anchors' voxel size) or without depth. ``depth`` float32 [H, W] metres."""
        return self._label[self._index.nearest_of_pixels(camera, depth, reach)]
