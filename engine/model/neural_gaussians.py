"""The Gaussians that decoders make of the anchors in one camera's view, and renderings of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..raster import Rendering, rasterize
from ..raster.conventions import NEAR
from ..raster.rendering import Backend
from ..scene import Camera


@dataclass(frozen=True)
class NeuralGaussians:
    """N Gaussians with opacity > 0, decoded for one camera; float32. ``means`` [N, 3] metres, ``scales`` [N, 3]
    standard deviations in metres, ``quats`` [N, 4] wxyz (not normalised), ``opacities`` [N] in (0, 1], ``colours`` [N,
    3], ``labels`` [N, C + S]: class probabilities, then instance-slot probabilities. ``visible`` int64 [V] are the
    decoded anchors, ``all_opacities`` [V, k] their opacities in (-1, 1) without a gradient, ``kept`` int64 [N] the
    indices of the N Gaussians in the flattened [V * k]. ``cluster_loss`` is the scalar L_cluster (the paper's equation
    "Cluster Loss"), 0 unless it was requested."""

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
        """Return the index of each Gaussian among all of the scene, with ``k`` to an anchor, int64 [N]."""
        return self.visible.index_select(0, self.kept // k) * k + self.kept % k

    def drawn_by(
        self, camera: Camera, labels: torch.Tensor | None = None, *, near: float = NEAR,
        rows: tuple[int, int] | None = None, top_k: int = 0, want_surface: bool = False,
        want_means2d_grad: bool = False, backend: Backend | None = None,
    ) -> Rendering:  # fmt: skip
        """Render these Gaussians from ``camera``, with ``labels`` float32 [N, L] or none. Draws only ``rows`` (first,
        last + 1) and Gaussians beyond ``near`` metres. The other options are those of `rasterize`."""
        drawn = (self.means, self.scales, self.quats, self.opacities, self.colours, labels)
        pose, lens = camera.camera_to_world.astype(np.float32), camera.K.astype(np.float32)
        return rasterize(
            *drawn, pose, lens, camera.width, camera.height, near=near, rows=rows, top_k=top_k,
            want_surface=want_surface, want_means2d_grad=want_means2d_grad,
            is_orthographic=camera.projection == "orthographic", backend=backend,
        )  # fmt: skip


# What the lifted model shows from one camera.


class ClipRange(NamedTuple):
    """The depths, metres, between which a Gaussian's centre must lie to be drawn; distances if ``along_rays``."""

    near: float = 0.0
    far: float = math.inf
    along_rays: bool = False


@dataclass(frozen=True, eq=False)
class PanopticRendering:
    """A rendered view, or a band of its rows (``camera`` is then the camera of these rows), before labels are decided.
    ``image`` float32 [H, W, 3]: sRGB in [0, 1], over black. ``alpha`` float32 [H, W]. ``depth`` float32 [H, W]: planar
    depth of the surface, metres, 0 = none. ``class_coverage`` float32 [H, W, C]: sum_i w_i * p_i(class) with a pixel's
    blending weights w_i; its sum over classes is alpha. ``instance_coverage`` float32 [H, W, S]: the same for
    instances; what is left of alpha belongs to no object. Channels are in the order of ``class_ids`` and
    ``instance_ids``. ``guessed`` float32 [H, W]: the share of the pixel that no photo saw or that is empty; None if
    nothing was removed from the scene."""

    camera: Camera
    image: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    class_coverage: NDArray[np.float32]
    instance_coverage: NDArray[np.float32]
    class_ids: tuple[int, ...]
    instance_ids: tuple[int, ...]
    guessed: NDArray[np.float32] | None = None
