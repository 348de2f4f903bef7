"""The two losses of a rendered label picture: L_sem and L_ins (see the paper's section "Loss Functions")."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from ..machine import memory

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
