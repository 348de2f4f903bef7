"""Finds the finest detail that the training pictures show at each position, and limits what is drawn to it. Rasterising
blurs each Gaussian by BLUR pixels squared, and training fits Gaussians under this blur. In a picture with smaller
pixels, from nearby or of a larger size, the same blur covers less of the world, and cracks open. So a Gaussian keeps at
least the blur of the training picture with the smallest pixels there, like the 3D smoothing filter of Mip-Splatting
(arXiv 2311.16493)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ..machine.compiled import Array, compiled
from ..raster.conventions import BLUR
from ..scene import Camera

NEAREST = 0.01
"""Metres. Anything nearer to a camera is not in its picture."""


def finest_pixels(points: NDArray[np.floating], cameras: Sequence[Camera]) -> NDArray[np.float32]:
    """Return the side in metres of the smallest pixel that any camera has at each of the ``points`` [N, 3], float32
    [N]; 0 where no picture contains the point. Ignores occlusion."""
    rows = [[*c.world_to_camera[:3].ravel(), c.fx, c.fy, c.cx, c.cy, c.width, c.height] for c in cameras]
    finest = np.zeros(len(points), np.float32)
    _find_finest(np.ascontiguousarray(points, np.float32), np.array(rows).reshape(-1, 18), finest)
    return finest


def blurred_scales(
    scales: torch.Tensor,  # [N, 3], metres
    finest: torch.Tensor,  # [N], metres
    depth: torch.Tensor,  # [N], metres
    camera: Camera,
) -> torch.Tensor:
    """Return scales [N, 3] with which ``camera``, which adds its own blur, draws Gaussians at ``depth`` as blurred as
    by pixels of side ``finest``; the same scales where the camera's pixels are larger."""
    own = depth / math.sqrt(camera.fx * camera.fy)
    return widened(scales, (finest.square() - own.square()).clamp_min(0.0).sqrt())


def widened(
    scales: torch.Tensor,  # [N, 3], metres
    pixels: torch.Tensor,  # [N], metres
) -> torch.Tensor:
    """Return scales [N, 3] that include the blur of pixels of side ``pixels``."""
    return (scales.square() + BLUR * pixels.square()[:, None]).sqrt()


@compiled
def _find_finest(points: Array, cameras: Array, finest: Array) -> None:
    """The compiled loop of ``finest_pixels``. ``cameras`` float64 [V, 18]: world to camera by row, and the lens."""
    for view in range(len(cameras)):
        m = cameras[view]
        focal = math.sqrt(m[12] * m[13])
        for row in range(len(points)):
            x, y, z = points[row, 0], points[row, 1], points[row, 2]
            depth = m[8] * x + m[9] * y + m[10] * z + m[11]
            if depth < NEAREST or (0.0 < finest[row] <= depth / focal):
                continue
            u = (m[0] * x + m[1] * y + m[2] * z + m[3]) / depth * m[12] + m[14]
            v = (m[4] * x + m[5] * y + m[6] * z + m[7]) / depth * m[13] + m[15]
            if 0.0 <= u < m[16] and 0.0 <= v < m[17]:
                finest[row] = depth / focal
