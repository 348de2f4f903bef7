"""The Gaussians that the decoders make from the anchors that one camera sees."""

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
        """Rows of these Gaussians among the scene's M * k, int64 [N]."""
        return self.visible.index_select(0, self.kept // k) * k + self.kept % k

    def drawn_by(
        self, camera: Camera, labels: torch.Tensor | None = None, *, near: float = NEAR,
        rows: tuple[int, int] | None = None, top_k: int = 0, want_surface: bool = False,
        want_means2d_grad: bool = False, backend: Backend | None = None,
    ) -> Rendering:  # fmt: skip
        """The camera's picture of these Gaussians, with ``labels`` float32 [N, L] of the caller's choice, or without
        labels. The other arguments are those of ``rasterize``."""
        drawn = (self.means, self.scales, self.quats, self.opacities, self.colours, labels)
        pose, lens = camera.camera_to_world.astype(np.float32), camera.K.astype(np.float32)
        return rasterize(
            *drawn, pose, lens, camera.width, camera.height, near=near, rows=rows, top_k=top_k,
            want_surface=want_surface, want_means2d_grad=want_means2d_grad,
            is_orthographic=camera.projection == "orthographic", backend=backend,
        )  # fmt: skip


# What the lifted model shows from one camera.


class ClipRange(NamedTuple):
    """Depths in metres: Gaussians centred nearer than ``near`` or farther than ``far`` are not drawn. They are planar,
    unless they are ``along_rays``."""

    near: float = 0.0
    far: float = math.inf
    along_rays: bool = False


@dataclass(frozen=True, eq=False)
class PanopticRendering:
    """A rendered view, or some rows of one (``camera`` is then that of the rows), before its pixels' labels are
    decided. ``image`` float32 [H, W, 3], sRGB-encoded in [0, 1] over black; ``alpha`` float32 [H, W]; ``depth`` float32
    [H, W], planar depth of the surface in metres (0 where nothing was hit). ``class_coverage`` float32 [H, W, C] holds
    sum_i w_i * p_i(class) for the blending weights w_i of the pixel's Gaussians: it sums to alpha over the classes.
    ``instance_coverage`` float32 [H, W, S] is the same for instances; the rest of alpha belongs to no object. Column c
    belongs to ``class_ids[c]``, column s to ``instance_ids[s]``. ``guessed`` float32 [H, W]: the share of the pixel
    that no photo ever saw or nothing covers; None if nothing was removed from the scene."""

    camera: Camera
    image: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    class_coverage: NDArray[np.float32]
    instance_coverage: NDArray[np.float32]
    class_ids: tuple[int, ...]
    instance_ids: tuple[int, ...]
    guessed: NDArray[np.float32] | None = None
