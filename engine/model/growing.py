"""Grows anchors where the rendering does not yet match the photos, and prunes anchors that stay transparent
(Scaffold-GS, section 3.3). Growth is decided by the gradients of the projected Gaussian centres, which only the
reconstruction loss and the depth loss (if any) reach; label losses never do. Pruning is decided by opacity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from .anchors import UNKNOWN_CLASS, Anchors
from .neural_gaussians import NeuralGaussians


@dataclass(frozen=True)
class GrowthRules:
    """When to grow and prune. ``gradient``: for level 0, the threshold on a Gaussian's mean gradient of the projected
    centre, NDC units; level i takes 2^i times that, cells of ``cell_voxels[i]`` voxels, and a random ``keep_share[i]``
    of the candidates. ``opacity``: anchors with a smaller mean summed opacity are pruned. ``seen_share``,
    ``visited_share``: how often a Gaussian or an anchor must have been visible before it is grown or pruned, as a share
    of the steps between two rounds. ``least_visits`` are always enough (None: no such limit); otherwise a short lift of
    many views would never decide on anchors that few views see."""

    gradient: float = 2e-4
    cell_voxels: tuple[int, ...] = (16, 4, 1)
    keep_share: tuple[float, ...] = (0.5, 0.75, 0.875)
    seen_share: float = 0.4
    visited_share: float = 0.8
    opacity: float = 0.005
    least_visits: int | None = None

    def enough(self, share: float, steps_between: int) -> float:
        """Return how many visits suffice to decide on an anchor: the ``share`` of the steps between rounds, or fewer if
        ``least_visits`` are set."""
        wanted = share * steps_between
        return wanted if self.least_visits is None else min(wanted, self.least_visits * share / self.visited_share)


@dataclass
class GrowthStatistics:
    """Sums since the last round, float32. By anchor: ``visits`` [M] and ``opacity`` [M]; by Gaussian: ``gradient`` [M,
    k] and how often it was ``drawn`` [M, k]."""

    visits: torch.Tensor
    opacity: torch.Tensor
    gradient: torch.Tensor
    drawn: torch.Tensor

    @classmethod
    def empty(cls, anchors: Anchors) -> GrowthStatistics:
        count, k, zeros = len(anchors), anchors.gaussians_per_anchor, anchors.position.new_zeros
        return cls(zeros(count), zeros(count), zeros(count, k), zeros(count, k))

    def tensors(self) -> dict[str, torch.Tensor]:
        return dict(vars(self))

    def on(self, device: torch.device | str) -> GrowthStatistics:
        return GrowthStatistics(**{name: tensor.to(device) for name, tensor in self.tensors().items()})

    def add(
        self,
        gaussians: NeuralGaussians,
        drawn: torch.Tensor,  # bool [N]
        means2d_gradient: torch.Tensor,  # [N, 2], per pixel
        width: int,
        height: int,
    ) -> None:
        """Add a step: the gradients of Gaussians where ``drawn``, converted to NDC units. No anchor may occur twice."""
        opacities, rows = gaussians.all_opacities, gaussians.rows(self.gradient.shape[1])
        self.visits.index_add_(0, gaussians.visible, opacities.new_ones(len(opacities)))
        self.opacity.index_add_(0, gaussians.visible, opacities.clamp_min(0).sum(dim=1))
        across, along = means2d_gradient[:, 0] * (0.5 * width), means2d_gradient[:, 1] * (0.5 * height)
        length = (across.square() + along.square()).sqrt()
        self.gradient.view(-1).index_add_(0, rows, length * drawn)
        self.drawn.view(-1).index_add_(0, rows, drawn.float())


@dataclass(frozen=True)
class GrowthRound:
    """The result of a round: which anchors to ``keep`` (bool [M]), and the new anchors ``grown``, to be appended."""

    keep: torch.Tensor
    grown: Anchors


def _cells(points: NDArray[np.float32], size: float) -> NDArray[np.int64]:
    return np.round(points.astype(np.float64) / size).astype(np.int64)


def _as_keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one int64 for each cell [n, 3], unique within 2^20 cells of the origin on each axis (20 km at 2 cm)."""
    shifted = cells + (1 << 20)
    return (shifted[:, 0] << 42) | (shifted[:, 1] << 21) | shifted[:, 2]


def grow_and_prune(
    anchors: Anchors,
    statistics: GrowthStatistics,
    rules: GrowthRules,
    *,
    voxel_size: float,
    steps_between: int,
    random: np.random.Generator,
    most_anchors: int,
) -> GrowthRound:
    """Return which anchors to keep and which to add, after ``steps_between`` steps. New ones lie in cells of some
    voxels of ``voxel_size`` metres. Sets the statistics of anchors visited often enough back to 0, in place. Nothing
    grows beyond ``most_anchors`` in all; if more could grow, ``random`` chooses among them."""
    judged = statistics.visits > rules.enough(rules.visited_share, steps_between)
    keep = ~(judged & (statistics.opacity < rules.opacity * statistics.visits))
    seen = statistics.drawn > rules.enough(rules.seen_share, steps_between)
    mean_gradient = (statistics.gradient / statistics.drawn.clamp_min(1)).numpy() * seen.numpy()
    reach = anchors.log_scale.detach()[:, None, :3].exp()
    centres = (anchors.position[:, None] + anchors.offset.detach() * reach).numpy()
    features = anchors.feature.detach().numpy()
    k = anchors.gaussians_per_anchor
    taken_by = anchors.position.numpy()

    room = max(0, most_anchors - int(keep.sum()))
    grown: list[Anchors] = []
    for level, cell_voxels in enumerate(rules.cell_voxels):
        size = voxel_size * cell_voxels
        candidate = mean_gradient >= rules.gradient * 2**level
        candidate &= random.random(candidate.shape) < rules.keep_share[level]
        which = np.flatnonzero(candidate.reshape(-1))
        if not len(which) or not room:
            continue
        cells = _cells(centres.reshape(-1, 3)[which], size)
        keys = _as_keys(cells)
        occupied = np.concatenate([taken_by, *[part.position.numpy() for part in grown]])
        free = ~np.isin(keys, _as_keys(_cells(occupied, size)))
        unique, first, cell_of = np.unique(keys[free], return_index=True, return_inverse=True)
        if not len(unique):
            continue
        feature = np.full((len(unique), features.shape[1]), -np.inf, np.float32)
        np.maximum.at(feature, cell_of, features[which[free] // k])  # the largest of a cell, as in Scaffold-GS
        position = (cells[free][first] * size).astype(np.float32)
        if len(unique) > room:
            chosen = np.sort(random.choice(len(unique), room, replace=False))  # in the order of the cells
            position, feature = position[chosen], feature[chosen]
        room -= len(position)
        count = len(position)
        grown.append(
            Anchors(
                position=torch.from_numpy(position),
                feature=torch.from_numpy(feature),
                offset=torch.zeros(count, k, 3),
                log_scale=torch.full((count, 6), float(np.log(size))),
                level=torch.full((count,), level + 1, dtype=torch.int64),
                initial_class=torch.full((count,), UNKNOWN_CLASS, dtype=torch.int64),
            )
        )
    statistics.gradient[seen] = 0
    statistics.drawn[seen] = 0
    statistics.visits[judged] = 0
    statistics.opacity[judged] = 0
    added = grown[0] if grown else anchors.select(torch.zeros(0, dtype=torch.int64))
    for part in grown[1:]:
        added = added.extended(part)
    return GrowthRound(keep, added)
