"""The two losses of a rendered label picture: L_sem and L_ins (see the paper's section "Loss Functions")."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch.autograd.function import once_differentiable

from ..machine import memory
from ..machine.compiled import Array, parallel_kernel
from ..machine.threads import parallel_for, worker_count
from ..scene import distinct_ids

TINY = 1e-8
"""Added to divisors, and to a probability before its logarithm."""
ONE, LEAST = np.float32(1), np.float32(TINY)
CHUNK = 8192
"""Pixels that a thread takes at once. Chunks depend only on the number of pixels, so sums over them have the same
bits however many threads there are."""


def label_losses(
    coverage: torch.Tensor,
    alpha: torch.Tensor,
    classes: int,
    semantic: torch.Tensor,
    instance: tuple[torch.Tensor, torch.Tensor],
) -> tuple[torch.Tensor, torch.Tensor]:
    """L_sem without L_cluster, and L_ins: -log of the rendered probability of the target label, as the mean over the
    pixels with a target. The losses of a pixel's two instance targets (linear assignment and M_match) are added.

    ``coverage`` float32 [H, W, C + S] holds blended probabilities of ``classes`` C classes, then of S slots; ``alpha``
    [H, W] is only a divisor: no gradient reaches it, since only the reconstruction loss may reach opacity. Targets are
    int16 [H, W]: the number of the class or slot, -1 where it is unknown. A loss without any target is 0.
    Differentiable once.
    """
    losses: tuple[torch.Tensor, torch.Tensor] = _LabelLosses.apply(coverage, alpha, classes, semantic, *instance)
    return losses


class _LabelLosses(torch.autograd.Function):
    """Writes one dense gradient for all three targets, where autograd would write one for each."""

    @staticmethod
    def forward(
        ctx: Any, coverage: torch.Tensor, alpha: torch.Tensor, classes: int, *targets: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ctx.shape, ctx.classes = coverage.shape, classes
        flat, opaque = _flat(coverage).reshape(-1, coverage.shape[-1]), _flat(alpha)
        ctx.targets = np.stack([_flat(target).astype(np.int16) for target in targets])
        ctx.slopes, sums = memory.empty(ctx.targets.shape, np.float32), np.zeros((-(-len(flat) // CHUNK), 4))
        parallel_for(worker_count(), _add_costs, flat, opaque, classes, ctx.targets, ctx.slopes, sums)
        *costs, by_class, by_slot = sums.sum(axis=0)
        ctx.counts = max(by_class, 1.0), max(by_slot, 1.0)
        semantic, instance = (coverage.new_tensor(cost / count) for cost, count in zip(costs, ctx.counts, strict=True))
        return semantic, instance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        semantic, instance = (float(each) / count for each, count in zip(gradients, ctx.counts, strict=True))
        gradient = memory.empty((ctx.targets.shape[1], ctx.shape[-1]), np.float32)
        factors = np.array([semantic, instance, instance], np.float32)
        parallel_for(worker_count(), _write_slopes, ctx.targets, ctx.classes, ctx.slopes, factors, gradient)
        return torch.from_numpy(gradient).view(ctx.shape), None, None, None, None, None


def _flat(tensor: torch.Tensor) -> NDArray[Any]:
    return tensor.detach().contiguous().numpy().reshape(-1)


@parallel_kernel
def _add_costs(
    worker: int, workers: int, coverage: Array, alpha: Array, classes: int, targets: Array, slopes: Array, sums: Array
) -> None:
    """From the ``targets`` int16 [3, P], the first of which are classes, fill ``slopes`` float32 [3, P], those of the
    costs by the coverage, and ``sums`` float64 [chunks, 4]: the costs of classes and of slots, and the pixels that have
    a target of each."""
    for chunk in range(worker, len(sums), workers):
        for pixel in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(alpha))):
            visible = alpha[pixel] + LEAST
            for place in range(3):
                number = targets[place, pixel]
                if number >= 0:
                    shown = coverage[pixel, number if place == 0 else number + classes]
                    probability = shown / visible + LEAST
                    slopes[place, pixel] = -ONE / (probability * visible)
                    sums[chunk, min(place, 1)] -= np.log(probability)
            sums[chunk, 2] += targets[0, pixel] >= 0
            sums[chunk, 3] += targets[1, pixel] >= 0 or targets[2, pixel] >= 0


@parallel_kernel
def _write_slopes(
    worker: int, workers: int, targets: Array, classes: int, slopes: Array, factors: Array, gradient: Array
) -> None:
    """Fill ``gradient`` [P, C + S]: the slopes times the ``factors`` [3] of their losses, in the targets' channels."""
    pixels = len(gradient)
    for pixel in range(pixels * worker // workers, pixels * (worker + 1) // workers):
        gradient[pixel] = 0
        for place in range(3):
            number = targets[place, pixel]
            if number >= 0:
                gradient[pixel, number if place == 0 else number + classes] += slopes[place, pixel] * factors[place]


# Linear assignment of a view's instances to the model's slots in each step. What never changes about a view is
# computed once.
#
# The cost of (instance, slot) is minus the mean probability of the slot over the instance's pixels; the Hungarian
# algorithm finds the assignment. If there are more instances than slots, some get none.

NO_SLOT = -1


@dataclass(frozen=True, eq=False)
class ThingSegments:
    """The thing segments of a view's input mask: ``row`` int32 [H, W] is the number of a pixel's segment, -1 = none;
    ``pixels`` int64 [I] is the number of pixels of each segment."""

    row: NDArray[np.int32]
    pixels: NDArray[np.int64]

    @classmethod
    def of(cls, ids: NDArray[np.integer]) -> ThingSegments:
        """The segments with these ids [H, W], 0 = none."""
        present, pixels = distinct_ids(np.asarray(ids, np.int32))
        row = np.searchsorted(present, ids).astype(np.int32)
        if len(present) and present[0] == 0:  # the smallest id, so it is first
            return cls(row - np.int32(1), pixels[1:])
        return cls(row, pixels)


def assigned_slots(
    coverage: torch.Tensor, alpha: torch.Tensor, first: int, things: ThingSegments, no_object: int | None = None
) -> torch.Tensor:
    """The target slot of each pixel, int16 [H, W], -1 where there is none.

    ``coverage`` float32 [H, W, C] holds the blended slot probabilities from channel ``first`` on; divided by ``alpha``
    [H, W] they are probabilities. No thing is assigned to the slot ``no_object``.
    """
    slots, segments = coverage.shape[-1] - first, len(things.pixels)
    slot_of_segment = np.full(segments + 1, NO_SLOT, np.int16)
    if slots and segments:
        flat = coverage.detach().contiguous().numpy().reshape(-1, coverage.shape[-1])
        sums = np.zeros((-(-len(flat) // CHUNK), segments, slots))
        opaque, row = alpha.detach().numpy().reshape(-1), things.row.reshape(-1)
        parallel_for(worker_count(), add_slots, flat, opaque, first, row, sums)
        mean = sums.sum(axis=0) / things.pixels[:, None]
        able = [slot for slot in range(slots) if slot != no_object]
        rows, columns = linear_sum_assignment(-mean[:, able])
        slot_of_segment[rows] = np.array(able, np.int16)[columns]
    return torch.from_numpy(slot_of_segment[things.row])  # row -1 is the last entry: no slot


@parallel_kernel
def add_slots(worker: int, workers: int, coverage: Array, alpha: Array, first: int, row: Array, sums: Array) -> None:
    """Add the slot probabilities of every ``workers``-th chunk of pixels, by segment, to ``sums`` float64
    [chunks, I, S]."""
    for chunk in range(worker, len(sums), workers):
        for pixel in range(chunk * CHUNK, min((chunk + 1) * CHUNK, len(row))):
            if row[pixel] < 0:
                continue
            share_of_alpha = ONE / (alpha[pixel] + LEAST)
            shown, total = coverage[pixel, first:], sums[chunk, row[pixel]]  # inner loops over whole arrays are fastest
            for slot in range(len(total)):
                total[slot] += shown[slot] * share_of_alpha
