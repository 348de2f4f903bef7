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
        ctx.shape, flat = coverage.shape, coverage.detach().reshape(-1, coverage.shape[-1])
        numbers = torch.stack([target.reshape(-1) for target in targets], 1).long()  # [P, 3]
        known = numbers >= 0
        # channels of the targets; without a target, the first channel, with a probability of 1 and no slope
        ctx.channels = (numbers + torch.tensor([0, classes, classes])) * known
        visible = alpha.detach().reshape(-1, 1) + TINY
        probability = (flat.gather(1, ctx.channels) / visible + TINY).where(known, 1.0)
        ctx.slopes = known / (-probability * visible)
        ctx.counts = [max(int(each.sum()), 1) for each in (known[:, 0], known[:, 1] | known[:, 2])]
        costs = -probability.log().numpy()  # NumPy's sums have the same bits for any number of threads
        return tuple(
            coverage.new_tensor(each.sum(dtype=np.float64) / count)
            for each, count in zip((costs[:, 0], costs[:, 1:]), ctx.counts, strict=True)
        )  # type: ignore[return-value]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        semantic, instance = (gradient / count for gradient, count in zip(gradients, ctx.counts, strict=True))
        gradient = torch.from_numpy(memory.empty((len(ctx.slopes), ctx.shape[-1]), np.float32)).zero_()
        gradient.scatter_add_(1, ctx.channels, ctx.slopes * torch.stack([semantic, instance, instance]))
        return gradient.view(ctx.shape), None, None, None, None, None


# Linear assignment of a view's instances to the model's slots in each step. What never changes about a view is
# computed once.
#
# The cost of (instance, slot) is minus the mean probability of the slot over the instance's pixels; the Hungarian
# algorithm finds the assignment. If there are more instances than slots, some get none.

NO_SLOT = -1
ONE, LEAST = np.float32(1), np.float32(TINY)
CHUNK = 8192
"""Pixels that a thread takes at once. Chunks depend only on the number of pixels, so sums over them have the same
bits however many threads there are."""


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
