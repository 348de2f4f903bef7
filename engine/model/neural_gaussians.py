"""What the decoders make of the anchors that one camera sees."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class NeuralGaussians:
    """N Gaussians with opacity > 0, decoded for one camera; float32.

    ``means`` [N, 3] metres, ``scales`` [N, 3] standard deviations in metres, ``quats`` [N, 4] wxyz (not normalised),
    ``opacities`` [N] in (0, 1], ``colours`` [N, 3], ``labels`` [N, C + S]: class probabilities, then instance-slot
    probabilities. ``visible`` int64 [V] are the anchors decoded, ``all_opacities`` [V, k] their opacities in
    (-1, 1) without a gradient, ``kept`` int64 [N] index into the flattened [V * k]. ``cluster_loss`` is the scalar
    L_cluster (paper, equation "Cluster Loss"), 0 unless it was asked for.
    """

    means: torch.Tensor
    scales: torch.Tensor
    quats: torch.Tensor
    opacities: torch.Tensor
    colours: torch.Tensor
    labels: torch.Tensor
    visible: torch.Tensor
    all_opacities: torch.Tensor
    kept: torch.Tensor
    cluster_loss: torch.Tensor

    def rows(self, k: int) -> torch.Tensor:
        """Which of the scene's M * k Gaussians they are, int64 [N]."""
        return self.visible.index_select(0, self.kept // k) * k + self.kept % k
