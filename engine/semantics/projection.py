"""Projecting a labelled cloud onto a view (paper, section "Reliable Anchor Point Regularization").

The masks that supervise newly grown Gaussians before self-training; the same function makes the consistent
instance masks M_match. Splat size, occlusion and holes are not given there: each pixel's surface takes the
nearest labelled point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..scene import Camera
from .cloud_index import CloudIndex


class LabelledPoints:
    """The points xyz float [N, 3] (world metres) whose ``labels`` int32 [N] are not 0, ready for look-up.

    ``spacing`` in metres is about the distance between neighbouring points.
    """

    def __init__(self, xyz: NDArray[np.floating], labels: NDArray[np.int32], spacing: float) -> None:
        if len(xyz) != len(labels):
            raise ValueError(f"{len(xyz)} points but {len(labels)} labels")
        known = np.flatnonzero(labels != 0)
        self.labels = labels
        self._index = CloudIndex(xyz[known], spacing)
        self._row = np.append(known, -1).astype(np.int32)

    def nearest(self, camera: Camera, depth: NDArray[np.float32], reach: float) -> NDArray[np.int32]:
        """Row in the cloud of the labelled point nearest to each pixel's surface, int32 [H, W], -1 for none."""
        return self._row[self._index.nearest_of_pixels(camera, depth, reach)]


def project_labels(
    camera: Camera, depth: NDArray[np.float32], points: LabelledPoints, reach: float
) -> NDArray[np.int32]:
    """Label of the nearest labelled point within ``reach`` metres (twice the anchors' voxel size) of each
    pixel's surface.

    ``depth`` float32 [H, W] metres; int32 [H, W], 0 where nothing is near or there is no depth: no
    supervision.
    """
    return read_labels(points.labels, points.nearest(camera, depth, reach))


def read_labels(labels: NDArray[np.int32], row: NDArray[np.int32]) -> NDArray[np.int32]:
    """labels [N] at rows int32 [H, W], 0 where the row is -1."""
    return np.append(labels, 0).astype(np.int32)[row]
