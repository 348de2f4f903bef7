"""The two losses of a rendered label picture: L_sem and L_ins (paper, section "Loss Functions")."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.autograd.function import once_differentiable

from ..machine import memory
from ..machine.compiled import Array, compiled, parallel_kernel
from ..machine.threads import parallel_for, worker_count

CHUNK = 8192
"""Pixels that a thread takes at a time. Chunks depend on the number of pixels alone, so sums over them have the same
bits however many threads there are."""
TINY = 1e-8
LEAST, ONE, ZERO = np.float32(TINY), np.float32(1), np.float32(0)


@compiled
def chunk_count(pixels: int) -> int:
    """The number of chunks of a picture with ``pixels`` pixels."""
    return -(-pixels // CHUNK)


@compiled
def chunk_range(chunk: int, pixels: int) -> Any:
    """The first pixel of a chunk, and the one behind its last."""
    return chunk * CHUNK, min((chunk + 1) * CHUNK, pixels)


def label_losses(
    coverage: torch.Tensor,
    alpha: torch.Tensor,
    classes: int,
    semantic: torch.Tensor,
    instance: tuple[torch.Tensor, torch.Tensor],
) -> tuple[torch.Tensor, torch.Tensor]:
    """L_sem without L_cluster, and L_ins: -log of the rendered probability of the target label, mean over the pixels
    that have any. A pixel's two instance targets (linear assignment and M_match) add up.

    ``coverage`` float32 [H, W, C + S] holds blended probabilities of ``classes`` C classes, then of S slots; ``alpha``
    [H, W] only divides: no gradient reaches it, since only the reconstruction loss may reach opacity. Targets are int16
    [H, W]: the class's or slot's number, -1 where none is known. A loss is 0 when it has no target at all.
    Differentiable once.
    """
    losses: tuple[torch.Tensor, torch.Tensor] = _LabelLosses.apply(coverage, alpha, classes, semantic, *instance)
    return losses


class PixelTargets(NamedTuple):
    """The targets of each pixel, int16 [P], -1 = none: class, slot by linear assignment, slot by M_match."""

    semantic: NDArray[np.int16]
    assigned: NDArray[np.int16]
    matched: NDArray[np.int16]


class CrossEntropies(NamedTuple):
    """What the targets cost. ``slopes`` float32 [P, 3]: of -log(probability) by the coverage, for each target. Of each
    chunk of pixels ``sums`` float64 [chunks, 2] of -log(probability) and ``counts`` int64 [chunks, 2] of the pixels
    that have a target, for both losses."""

    slopes: NDArray[np.float32]
    sums: NDArray[np.float64]
    counts: NDArray[np.int64]


class _LabelLosses(torch.autograd.Function):
    """The dense gradient of both losses is written once, where slices, divisions and logarithms of whole label pictures
    would write many."""

    @staticmethod
    def forward(
        ctx: Any, coverage: torch.Tensor, alpha: torch.Tensor, classes: int, *targets: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        flat = coverage.detach().contiguous().numpy().reshape(-1, coverage.shape[-1])
        ctx.targets = PixelTargets(*(target.to(torch.int16).contiguous().numpy().reshape(-1) for target in targets))
        ctx.slopes = memory.empty((len(flat), len(targets)), np.float32)
        chunks = chunk_count(len(flat))
        entropies = CrossEntropies(ctx.slopes, np.zeros((chunks, 2)), np.zeros((chunks, 2), np.int64))
        opaque = alpha.detach().contiguous().numpy().reshape(-1)
        parallel_for(worker_count(), add_cross_entropies, flat, opaque, classes, ctx.targets, entropies)
        ctx.known = np.maximum(entropies.counts.sum(axis=0), 1)
        ctx.classes, ctx.shape = classes, coverage.shape
        semantic, instance = entropies.sums.sum(axis=0) / ctx.known
        return coverage.new_tensor(semantic), coverage.new_tensor(instance)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        scales = np.array([gradient.item() for gradient in gradients] / ctx.known, np.float32)
        gradient = memory.empty((len(ctx.slopes), ctx.shape[-1]), np.float32)
        parallel_for(worker_count(), spread_slopes, ctx.classes, ctx.targets, ctx.slopes, scales, gradient)
        return torch.from_numpy(gradient).view(ctx.shape), None, None, None, None, None


@compiled
def probability_and_slope(shown: float, alpha: float) -> Any:
    """The probability that a coverage stands for, and the slope of its -log by the coverage."""
    visible = alpha + LEAST
    probability = shown / visible + LEAST
    return np.float64(probability), -ONE / (probability * visible)


@parallel_kernel
def add_cross_entropies(
    worker: int,
    workers: int,
    coverage: Array,
    alpha: Array,
    classes: int,
    targets: PixelTargets,
    entropies: CrossEntropies,
) -> None:
    """Fills ``entropies``, every ``workers``-th chunk of pixels."""
    semantic, assigned, matched = targets.semantic, targets.assigned, targets.matched
    slopes, sums, counts = entropies.slopes, entropies.sums, entropies.counts
    for chunk in range(worker, len(sums), workers):
        start, end = chunk_range(chunk, len(alpha))
        # Probabilities are multiplied as long as float64 holds the product: few logarithms are left to take.
        likely, alike = 1.0, 1.0
        for pixel in range(start, end):
            known, taken, agreed = semantic[pixel], assigned[pixel], matched[pixel]
            if known >= 0:
                probability, slopes[pixel, 0] = probability_and_slope(coverage[pixel, known], alpha[pixel])
                likely *= probability
                counts[chunk, 0] += 1
            if taken >= 0:
                probability, slopes[pixel, 1] = probability_and_slope(coverage[pixel, classes + taken], alpha[pixel])
                alike *= probability
            if agreed >= 0:
                probability, slopes[pixel, 2] = probability_and_slope(coverage[pixel, classes + agreed], alpha[pixel])
                alike *= probability
            if taken >= 0 or agreed >= 0:
                counts[chunk, 1] += 1
            if not 1e-200 < likely < 1e200:  # also when it is no number
                sums[chunk, 0] -= math.log(likely)
                likely = 1.0
            if not 1e-200 < alike < 1e200:
                sums[chunk, 1] -= math.log(alike)
                alike = 1.0
        sums[chunk, 0] -= math.log(likely)
        sums[chunk, 1] -= math.log(alike)


@parallel_kernel
def spread_slopes(
    worker: int, workers: int, classes: int, targets: PixelTargets, slopes: Array, scales: Array, gradient: Array
) -> None:
    """Every ``workers``-th chunk: the slopes times ``scales`` [2] (of either loss) at their channels of ``gradient``
    [P, C + S], zero elsewhere."""
    semantic, assigned, matched = targets.semantic, targets.assigned, targets.matched
    for chunk in range(worker, chunk_count(len(gradient)), workers):
        start, end = chunk_range(chunk, len(gradient))
        for pixel in range(start, end):
            for channel in range(gradient.shape[1]):
                gradient[pixel, channel] = ZERO
            if semantic[pixel] >= 0:
                gradient[pixel, semantic[pixel]] = scales[0] * slopes[pixel, 0]
            if assigned[pixel] >= 0:
                gradient[pixel, classes + assigned[pixel]] += scales[1] * slopes[pixel, 1]
            if matched[pixel] >= 0:
                gradient[pixel, classes + matched[pixel]] += scales[1] * slopes[pixel, 2]
