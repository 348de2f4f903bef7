"""A furnished room as Gaussians on its surfaces. The same count always gives the same numbers."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT, FOCAL = 640, 480, 500.0
CHANNELS = 46
EYE, TARGET = np.array([-2.3, -1.7, 1.55]), np.array([1.3, 0.9, 0.75])
BOXES = (  # metres, opposite corners: the room, a table, a sofa, a cupboard, a bed
    ((-3.0, -2.5, 0.0), (3.0, 2.5, 2.8)),
    ((0.2, -0.4, 0.70), (1.8, 0.5, 0.75)),
    ((-1.2, 1.5, 0.0), (0.9, 2.4, 0.95)),
    ((2.4, 0.9, 0.0), (2.95, 2.2, 2.0)),
    ((1.9, -2.4, 0.0), (2.9, -1.0, 0.5)),
)


class Workload(NamedTuple):
    """float32: means, scales [N, 3] metres, quats [N, 4] wxyz, opacities [N], colours [N, 3], labels [N, 46];
    the camera."""

    means: NDArray[np.float32]
    scales: NDArray[np.float32]
    quats: NDArray[np.float32]
    opacities: NDArray[np.float32]
    colours: NDArray[np.float32]
    labels: NDArray[np.float32]
    camera_to_world: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    width: int
    height: int


def room_workload(count: int, width: int = WIDTH, height: int = HEIGHT) -> Workload:
    """``count`` flat Gaussians on the sides of the boxes, as wide as they are far apart. Another size scales the
    intrinsics."""
    random = np.random.default_rng(20240607 + count)
    low, high = (np.repeat(corner, 6, axis=0) for corner in np.swapaxes(np.array(BOXES), 0, 1))
    axis, is_far = np.tile(np.repeat([0, 1, 2], 2), len(BOXES)), np.tile([False, True], 3 * len(BOXES))
    size = high - low
    areas = size.prod(axis=1) / size[np.arange(len(axis)), axis]
    face = random.choice(len(areas), count, p=areas / areas.sum())
    spacing, rows = np.sqrt(areas.sum() / count), np.arange(count)
    means = low[face] + random.random((count, 3)) * size[face]
    means[rows, axis[face]] = np.where(is_far, high[np.arange(len(axis)), axis], low[np.arange(len(axis)), axis])[face]
    scales = spacing * np.exp(random.normal(0.0, 0.4, (count, 3)))
    scales[rows, axis[face]] *= 0.15
    quats = [1.0, 0.0, 0.0, 0.0] + random.normal(0.0, 0.1, (count, 4))
    surface = np.random.default_rng(7)
    colours = surface.uniform(0.15, 0.85, (len(areas), 3))[face] + random.normal(0.0, 0.05, (count, 3))
    labels = surface.normal(0.0, 1.0, (len(areas), CHANNELS))[face] + random.normal(0.0, 0.3, (count, CHANNELS))
    arrays = means, scales, quats, random.uniform(0.1, 0.95, count), colours.clip(0.02, 0.98), labels
    pose, forward = np.eye(4), (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(forward, right), forward], 1), EYE
    focal = FOCAL * width / WIDTH, FOCAL * height / HEIGHT
    intrinsics = np.array([[focal[0], 0.0, width / 2], [0.0, focal[1], height / 2], [0.0, 0.0, 1.0]])
    return Workload(*(array.astype(np.float32) for array in arrays), pose, intrinsics, width, height)
