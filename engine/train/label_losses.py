"""The losses of rendered labels, L_sem and L_ins (the paper's section "Loss Functions"), and the linear assignment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch.autograd.function import once_differentiable
from torch.nn import functional

from ..scene import distinct_ids

TINY = 1e-8
"""Added to divisors, and to a probability before its logarithm."""


def label_losses(
    coverage: torch.Tensor,  # [H, W, C + S], blended probabilities
    alpha: torch.Tensor,  # [H, W]
    classes: int,
    semantic: torch.Tensor,  # int16 [H, W], -1 = unknown
    instance: tuple[torch.Tensor, torch.Tensor],  # int16 [H, W] each, -1 = unknown
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return L_sem without L_cluster, and L_ins, as scalars: the mean of -log of the rendered probability of the target
    label over the pixels with a target, 0 if there is none. ``coverage`` has channels for ``classes`` (C), then S
    slots; ``semantic`` and ``instance`` hold target channels. L_ins adds a pixel's two instance targets, from linear
    assignment and M_match. ``alpha``, a mere divisor, gets no gradient, so that labels do not change it."""
    losses: tuple[torch.Tensor, torch.Tensor] = _LabelLosses.apply(coverage, alpha, classes, semantic, *instance)
    return losses


class _LabelLosses(torch.autograd.Function):
    """Computes the gradient of all three targets in one dense array; autograd would make an array for each."""

    @staticmethod
    def forward(
        ctx: Any, coverage: torch.Tensor, alpha: torch.Tensor, classes: int, *targets: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        numbers = torch.stack([target.reshape(-1) for target in targets], 1).long()  # [P, 3]
        known, visible = numbers >= 0, alpha.detach().reshape(-1, 1) + TINY
        numbers[:, 1:] += classes  # slots come after the classes; `known` says which of these are valid
        # channels of the targets; without a target, the first channel, with a probability of 1 and no slope
        ctx.channels, ctx.shape = numbers * known, coverage.shape
        probability = coverage.flatten(0, 1).gather(1, ctx.channels) / visible + TINY
        probability = probability.where(known, 1.0)
        ctx.slopes = known / (-probability * visible)
        has_target = torch.stack([known[:, 0], known[:, 1] | known[:, 2]], 1)
        ctx.counts = has_target.sum(0).clamp_min(1)  # no 0 / 0: without a target the cost is 0
        costs = -probability.log().double().sum(0)  # in double, so that its order does not matter
        return (torch.stack([costs[0], costs[1] + costs[2]]) / ctx.counts).float().unbind()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        semantic, instance = (torch.stack(gradients) / ctx.counts).unbind()
        gradient = ctx.slopes.new_zeros(len(ctx.slopes), ctx.shape[-1])
        # added up, as both slots of a pixel may be one channel
        gradient.scatter_add_(1, ctx.channels, ctx.slopes * torch.stack([semantic, instance, instance]))
        return gradient.view(ctx.shape), None, None, None, None, None


# Linear assignment of a view's instances to the model's slots in each step. What never changes about a view is
# computed once.
#
# The cost of (instance, slot) is minus the mean probability of the slot over the instance's pixels; the Hungarian
# algorithm finds the assignment. If there are more instances than slots, some get none.

NO_SLOT = -1


@dataclass(frozen=True, eq=False)
class ThingSegments:
    """The thing segments of a view's input mask, numbered from 0. ``row`` int32 [H, W] (int16 on a device): the number
    of each pixel's segment, -1 = none; ``pixels`` int64 [I]: how many pixels each segment has."""

    row: NDArray[np.int32] | torch.Tensor
    pixels: NDArray[np.int64]

    @classmethod
    def of(cls, ids: NDArray[np.integer]) -> ThingSegments:
        """Number the segments of a mask whose ids are given for each pixel, [H, W], 0 = none."""
        present, pixels = distinct_ids(np.asarray(ids, np.int32))
        row = np.searchsorted(present, ids).astype(np.int32)
        if len(present) and present[0] == 0:  # the smallest id, so it is first
            return cls(row - np.int32(1), pixels[1:])
        return cls(row, pixels)


def assigned_slots(
    coverage: torch.Tensor,  # [H, W, C], blended probabilities
    alpha: torch.Tensor,  # [H, W]
    first: int,
    things: ThingSegments,
    no_object: int | None = None,
) -> torch.Tensor:
    """Assign each thing segment to the slot that is rendered in it most probably, one to one (Hungarian algorithm).
    Return each pixel's slot, int16 [H, W], -1 = none. Slots are ``coverage``'s channels from ``first`` on; ``coverage``
    divided by ``alpha`` is a probability. The slot ``no_object`` is left out. On CUDA, only means are copied back."""
    slots, segments = coverage.shape[-1] - first, len(things.pixels)
    row, slot_of_segment = torch.as_tensor(things.row).long(), np.full(segments + 1, NO_SLOT, np.int16)
    if slots and segments:
        inside = functional.one_hot(row.reshape(-1) + 1, segments + 1)[:, 1:].float()  # without row -1
        shown = coverage.detach().flatten(0, 1)[:, first:] / (alpha.detach().reshape(-1, 1) + TINY)
        mean = np.array((inside.T @ shown).tolist()) / things.pixels[:, None]
        able = [slot for slot in range(slots) if slot != no_object]
        rows, columns = linear_sum_assignment(-mean[:, able])
        slot_of_segment[rows] = np.array(able, np.int16)[columns]
    slot_of_row = torch.from_numpy(slot_of_segment).to(row.device, non_blocking=True)
    return slot_of_row[row]  # row -1 is the last entry: no slot
