"""The Gaussians that the decoders make from the anchors that one camera sees."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..raster import Rendering, rasterize
from ..scene import Camera


@dataclass(frozen=True)
class NeuralGaussians:
    """N Gaussians with opacity > 0, decoded for one camera; float32.

    ``means`` [N, 3] metres, ``scales`` [N, 3] standard deviations in metres, ``quats`` [N, 4] wxyz (not normalised),
    ``opacities`` [N] in (0, 1], ``colours`` [N, 3], ``labels`` [N, C + S]: class probabilities, then instance-slot
    probabilities. ``visible`` int64 [V] are the decoded anchors, ``all_opacities`` [V, k] their opacities in (-1, 1)
    without a gradient, ``kept`` int64 [N] the indices of the N Gaussians in the flattened [V * k]. ``cluster_loss`` is
    the scalar L_cluster (the paper's equation "Cluster Loss"), 0 unless it was requested.
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
        """Rows of these Gaussians among the scene's M * k, int64 [N]."""
        return self.visible.index_select(0, self.kept // k) * k + self.kept % k

    def drawn_by(
        self, camera: Camera, labels: torch.Tensor | None = None, *, top_k: int = 0, want_means2d_grad: bool = False
    ) -> Rendering:
        """The camera's whole picture of these Gaussians, with ``labels`` float32 [N, L] of the caller's choice, or
        without labels. The other arguments are those of ``rasterize``."""
        return rasterize(
            self.means,
            self.scales,
            self.quats,
            self.opacities,
            self.colours,
            labels,
            torch.from_numpy(camera.camera_to_world).float(),
            torch.from_numpy(camera.K).float(),
            camera.width,
            camera.height,
            top_k=top_k,
            want_means2d_grad=want_means2d_grad,
        )
