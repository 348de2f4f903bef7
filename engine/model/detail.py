"""The finest detail that the training pictures show at each position, which limits the detail of what is drawn.

Every picture blurs Gaussians by BLUR, and training fits them under this blur. In a picture with smaller pixels, from
nearby or of a larger size, the same blur covers less of the world, and cracks open. So a Gaussian keeps at least the
blur that it had in the training picture with the smallest pixels there, after the 3D smoothing filter of Mip-Splatting
(arXiv 2311.16493).
"""

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
    """The side in metres, float32 [N], of the smallest pixel that any camera has at each of the ``points`` [N, 3],
    ignoring occlusion; 0 where no picture contains the position."""
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
    """Standard deviations, widened so that the ``camera``, which blurs them once more, shows Gaussians at ``depth``
    with the blur of pixels with the side ``finest``, if its own are smaller."""
    own = depth / math.sqrt(camera.fx * camera.fy)
    return widened(scales, (finest.square() - own.square()).clamp_min(0.0).sqrt())


def widened(
    scales: torch.Tensor,  # [N, 3], metres
    pixels: torch.Tensor,  # [N], metres
) -> torch.Tensor:
    """Standard deviations with the blur of pixels with the side ``pixels``."""
    return (scales.square() + BLUR * pixels.square()[:, None]).sqrt()


@compiled
def _find_finest(points: Array, cameras: Array, finest: Array) -> None:
    """The loop behind ``finest_pixels``. ``cameras`` float64 [V, 18]: world to camera row by row, and the lens."""
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
