"""Anchors: voxel centres that each own ``k`` neural Gaussians (see the paper's section "Structured Panoptic-Aware Scene
Representation", and Scaffold-GS). An anchor never moves. Learnt are its feature, the offsets of its Gaussians, and six
log scales: three scale the offsets, three limit the size of the Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

UNKNOWN_CLASS = 0
"""Initial class of an anchor without a consistent label, and of every grown anchor."""


@dataclass
class Anchors:
    """The anchors' tensors. Row i of each belongs to anchor i; they are float32 unless stated otherwise. ``position``
    [M, 3] metres, fixed; ``feature`` [M, F]; ``offset`` [M, k, 3] in units of the offset scale; ``log_scale`` [M, 6]
    (0:3 offset scale, 3:6 Gaussian scale, log metres); ``level`` int64 [M], 0 for initial anchors and 1..3 for those
    grown at the 1st to 3rd cell size; ``initial_class`` int64 [M], the class id voted by the semantic point cloud (0 =
    unknown), which is the target of the cluster loss."""

    position: torch.Tensor
    feature: torch.Tensor
    offset: torch.Tensor
    log_scale: torch.Tensor
    level: torch.Tensor
    initial_class: torch.Tensor

    LEARNT = ("feature", "offset", "log_scale")
    FIXED = ("position", "level", "initial_class")

    def __len__(self) -> int:
        return len(self.position)

    @property
    def gaussians_per_anchor(self) -> int:
        return self.offset.shape[1]

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return all tensors by name, detached from autograd."""
        return {name: getattr(self, name).detach() for name in (*self.LEARNT, *self.FIXED)}

    def on(self, device: torch.device | str) -> Anchors:
        """Return the anchors on ``device``: new leaf tensors, unless they are there already."""
        return Anchors(**{name: tensor.to(device) for name, tensor in self.tensors().items()})

    def select(self, rows: torch.Tensor) -> Anchors:
        """Return the anchors at ``rows`` (bool [M], or int64 indices), in that order, as new leaf tensors."""
        return Anchors(**{name: tensor[rows].clone() for name, tensor in self.tensors().items()})

    def extended(self, more: Anchors) -> Anchors:
        """Return these anchors followed by ``more``."""
        mine, theirs = self.tensors(), more.tensors()
        return Anchors(**{name: torch.cat([mine[name], theirs[name]]) for name in mine})


def spacing(positions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return each position's root mean square distance, metres, to its three nearest others, float32 [M]. Scaffold-GS
    uses it as the initial scale."""
    neighbours = min(4, len(positions))  # the first is the anchor itself
    if neighbours < 2:
        return np.full(len(positions), 0.05, np.float32)
    distance, _ = cKDTree(positions).query(positions, k=neighbours)
    return np.sqrt(np.maximum((distance[:, 1:] ** 2).mean(axis=1), 1e-7)).astype(np.float32)  # 1e-7: as in Scaffold-GS


def initial_anchors(
    positions: NDArray[np.float32],
    classes: NDArray[np.integer],
    *,
    gaussians_per_anchor: int,
    feature: NDArray[np.float32],
    voxel_size: float,
) -> Anchors:
    """Make anchors at ``positions`` [M, 3], metres, with class ids ``classes`` [M] (0 = unknown) and features [M, F].
    Their initial scale is at most three voxels, as a lone point would else start as one huge Gaussian."""
    count = len(positions)
    log_scale = np.log(np.minimum(spacing(positions), 3.0 * voxel_size))
    return Anchors(
        position=torch.from_numpy(np.ascontiguousarray(positions, np.float32)),
        feature=torch.from_numpy(np.ascontiguousarray(feature, np.float32)),
        offset=torch.zeros(count, gaussians_per_anchor, 3),
        log_scale=torch.from_numpy(np.repeat(log_scale[:, None], 6, axis=1)),
        level=torch.zeros(count, dtype=torch.int64),
        initial_class=torch.from_numpy(np.asarray(classes, np.int64)),
    )


def seeded_features(
    rgb: NDArray[np.uint8], class_id: NDArray[np.integer], instance_id: NDArray[np.integer], *, features: int, seed: int
) -> NDArray[np.float32]:
    """Return initial features that differ by colour and label, float32 [M, ``features``]. Three entries are ``rgb``
    uint8 [M, 3], scaled to [-1, 1]. Half of the other entries are a random code of +-1 for the class, the other half a
    code for the instance; unknown labels (0) give zeros, and no two labels share a code. In Scaffold-GS and the paper
    all start from zero, and take thousands of steps to become different, but a lift on a CPU has only hundreds."""
    seeded = np.zeros((len(rgb), features), np.float32)
    seeded[:, :3] = rgb.astype(np.float32) / 127.5 - 1.0
    half = 3 + (features - 3) // 2
    for labels, columns, purpose in ((class_id, slice(3, half), 11), (instance_id, slice(half, features), 12)):
        width = columns.stop - columns.start
        seeded[:, columns] = _codes(int(labels.max(initial=0)), width, np.random.default_rng([seed, purpose]))[labels]
    return seeded


def _codes(labels: int, width: int, random: np.random.Generator) -> NDArray[np.float32]:
    """Return a random code of +-1 for each label, float32 [``labels`` + 1, ``width``], zeros for label 0. If there are
    enough codes, no two labels share one: nothing else would distinguish two identical chairs."""
    sides = np.array([-1.0, 1.0], np.float32)
    codes = random.choice(sides, (labels + 1, width))
    codes[0] = 0.0
    taken: set[bytes] = set()
    for row in codes[1:]:
        while row.tobytes() in taken and len(taken) < 2**width:
            row[:] = random.choice(sides, width)
        taken.add(row.tobytes())
    return codes


class AnchorsInView(NamedTuple):
    """The rows ``visible`` int64 [V] of ``anchors``, to be decoded as seen from ``centre`` [3]. ``channels`` [M]:
    semantic channels of anchors' classes, for the cluster loss. ``known_labels`` are used instead of decoded ones."""

    anchors: Anchors
    visible: torch.Tensor  # int64 [V], without repetitions
    centre: torch.Tensor  # [3], metres; in torch also [V, 3]
    channels: torch.Tensor | None = None  # int64 [M], -1 = none
    known_labels: torch.Tensor | None = None  # float32 [M * k, L]
