"""A furnished room as Gaussians on its surfaces: what the benchmark draws. The same count always gives the same
numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT, FOCAL = 640, 480, 500.0
CHANNELS = 46
SEED = 20240607
EYE, TARGET = np.array([-2.3, -1.7, 1.55]), np.array([1.3, 0.9, 0.75])
ROOM = ((-3.0, -2.5, 0.0), (3.0, 2.5, 2.8))
FURNITURE = (  # metres, opposite corners
    ((0.2, -0.4, 0.70), (1.8, 0.5, 0.75)),
    ((0.3, -0.3, 0.0), (0.36, -0.24, 0.70)),
    ((1.64, -0.3, 0.0), (1.70, -0.24, 0.70)),
    ((0.3, 0.34, 0.0), (0.36, 0.40, 0.70)),
    ((1.64, 0.34, 0.0), (1.70, 0.40, 0.70)),
    ((-1.2, 1.5, 0.0), (0.9, 2.4, 0.45)),
    ((-1.2, 2.1, 0.45), (0.9, 2.4, 0.95)),
    ((2.4, 0.9, 0.0), (2.95, 2.2, 2.0)),
    ((1.9, -2.4, 0.0), (2.9, -1.0, 0.5)),
    ((-0.6, -0.2, 0.0), (-0.2, 0.2, 0.45)),
    ((0.8, -0.1, 0.75), (1.2, 0.2, 1.05)),
)


@dataclass(frozen=True, eq=False)
class Workload:
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

    @property
    def gaussians(self) -> tuple[NDArray[np.float32], ...]:
        """The first arguments of ``rasterize``."""
        return self.means, self.scales, self.quats, self.opacities, self.colours

    @property
    def view(self) -> tuple[NDArray[np.float64], NDArray[np.float64], int, int]:
        """Its last arguments: the camera's."""
        return self.camera_to_world, self.intrinsics, self.width, self.height


def _faces() -> tuple[NDArray[np.float64], ...]:
    """Origins, two edges and the normal axis of every rectangle: the room's six, the furniture's without
    undersides."""
    origins, first, second, axes = [], [], [], []
    for place, (low, high) in enumerate((ROOM, *FURNITURE)):
        size = np.subtract(high, low)
        for axis in range(3):
            for side in (0, 1):
                if place > 0 and axis == 2 and side == 0 and low[2] == 0.0:
                    continue
                u, v = (a for a in range(3) if a != axis)
                origin = np.array(low)
                origin[axis] = high[axis] if side else low[axis]
                origins.append(origin)
                first.append(np.eye(3)[u] * size[u])
                second.append(np.eye(3)[v] * size[v])
                axes.append(np.eye(3)[axis])
    return np.array(origins), np.array(first), np.array(second), np.array(axes)


def _camera_to_world() -> NDArray[np.float64]:
    forward = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = EYE
    return pose


def _quaternions(
    axes: NDArray[np.float64], turn: NDArray[np.float64], tilt: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The local z axis along ``axes``, turned about it by ``turn`` radians, then tilted a little."""
    # halfway rotation from z to the axis, then the turn
    w = 1.0 + axes[:, 2]
    onto = np.stack([w, -axes[:, 1], axes[:, 0], np.zeros(len(axes))], 1)
    onto /= np.linalg.norm(onto, axis=1, keepdims=True)
    about = np.stack([np.cos(turn / 2), np.zeros_like(turn), np.zeros_like(turn), np.sin(turn / 2)], 1)
    nudge = np.concatenate([np.ones((len(axes), 1)), tilt / 2], 1)
    quats = _multiply(nudge, _multiply(onto, about))
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _multiply(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    (aw, ax, ay, az), (bw, bx, by, bz) = a.T, b.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        1,
    )


def room_workload(count: int, width: int = WIDTH, height: int = HEIGHT) -> Workload:
    """``count`` Gaussians, flat on the surfaces, as wide as they are far apart; another size scales the
    intrinsics."""
    random = np.random.default_rng(SEED + count)
    origins, first, second, axes = _faces()
    areas = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    face = random.choice(len(areas), size=count, p=areas / areas.sum())
    spacing = np.sqrt(areas.sum() / count)
    across = random.random((count, 2))
    means = origins[face] + across[:, :1] * first[face] + across[:, 1:] * second[face]
    means += axes[face] * random.normal(0.0, 0.05 * spacing, (count, 1))
    scales = spacing * np.exp(random.normal(0.0, [0.4, 0.4, 0.3], (count, 3))) * [1.0, 1.0, 0.15]
    quats = _quaternions(axes[face], random.random(count) * 2 * np.pi, random.normal(0.0, 0.1, (count, 3)))
    surface = np.random.default_rng(7)
    colours = surface.uniform(0.15, 0.85, (len(areas), 3))[face]
    colours += (np.floor(means / 0.25).sum(1) % 2)[:, None] * 0.15 + random.normal(0.0, 0.03, (count, 3))
    labels = surface.normal(0.0, 1.0, (len(areas), CHANNELS))[face] + random.normal(0.0, 0.3, (count, CHANNELS))
    focal_x, focal_y = FOCAL * width / WIDTH, FOCAL * height / HEIGHT
    intrinsics = np.array([[focal_x, 0.0, width / 2], [0.0, focal_y, height / 2], [0.0, 0.0, 1.0]])
    opacities = random.uniform(0.1, 0.95, count)
    return Workload(
        means.astype(np.float32),
        scales.astype(np.float32),
        quats.astype(np.float32),
        opacities.astype(np.float32),
        colours.clip(0.02, 0.98).astype(np.float32),
        labels.astype(np.float32),
        _camera_to_world(),
        intrinsics,
        width,
        height,
    )
