"""Projecting a labelled cloud onto a view (paper, section "Reliable Anchor Point Regularization").

These masks supervise newly grown Gaussians before self-training. The same projection makes the consistent instance
masks M_match. The paper gives no splat size, and does not treat occlusion and holes. Here each pixel's surface takes
the nearest labelled point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..scene import Camera
from .cloud_index import CloudIndex


class LabelledPoints:
    """The points xyz float [N, 3] (world metres) whose ``labels`` int32 [N] are not 0, ready for look-up."""

    def __init__(self, xyz: NDArray[np.floating], labels: NDArray[np.int32]) -> None:
        known = labels != 0
        self._index = CloudIndex(xyz[known])
        self._label = np.append(labels[known], 0).astype(np.int32)  # the last is that of row -1, no point

    def project(self, camera: Camera, depth: NDArray[np.float32], reach: float) -> NDArray[np.int32]:
        """Label of the nearest labelled point within ``reach`` metres (twice the anchors' voxel size) of each pixel's
        surface.

        ``depth`` float32 [H, W] metres; int32 [H, W], 0 (no supervision) where no point is near or there is no depth.
        """
        return self._label[self._index.nearest_of_pixels(camera, depth, reach)]
