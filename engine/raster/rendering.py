"""The arguments and results that all back ends share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from torch import Tensor

Backend = Literal["numba", "gsplat"]
BACKENDS: tuple[Backend, ...] = ("numba", "gsplat")


class GaussianSet(NamedTuple):
    """N Gaussians, as taken by ``rasterize``: ``means`` and ``scales`` [N, 3] in metres, ``quats`` [N, 4] wxyz,
    ``opacities`` [N], ``colours`` [N, 3], ``labels`` [N, C] or None."""

    means: Tensor
    scales: Tensor
    quats: Tensor
    opacities: Tensor
    colours: Tensor
    labels: Tensor | None


class Wanted(NamedTuple):
    """What to return besides layers: ``top_k`` contributors per pixel, the ``surface``, the gradient of ``means2d``."""

    top_k: int
    surface: bool
    means2d_grad: bool


@dataclass(frozen=True, eq=False)
class Rendering:
    """One view of a set of N Gaussians, over black. Float tensors have the dtype and the device of ``means``.

    With the blending weights w_i = alpha_i * prod_{j<i} (1 - alpha_j) of a pixel's Gaussians, front to back: ``image``
    [H, W, 3] is sum_i w_i colour_i. ``labels`` [H, W, C] or None is sum_i w_i label_i, with detached weights: its
    gradient reaches the label values and nothing else. ``alpha`` [H, W] is sum_i w_i, in [0, 1]. ``depth`` [H, W],
    metres, is sum_i w_i z_i with the planar camera depth z_i of the centres. It is not normalised: divide by ``alpha``
    for the expected depth. ``visible`` bool [N]: the Gaussian lies beyond the near plane and its footprint (every pixel
    where its alpha can reach 1/255) overlaps the image. It may still be hidden behind others. ``means2d`` [N, 2],
    pixels: the projected centres; rows of Gaussians that are not visible hold zeros. With ``want_means2d_grad`` it is a
    leaf whose ``.grad`` [N, 2] holds dLoss/d(2D mean) after ``backward`` (zero where not visible).

    Not differentiable: ``top_indices`` int32 [H, W, top_k] and ``top_weights`` [H, W, top_k], or None: the Gaussians
    with the largest weights of each pixel, largest first, -1 and 0 where there are fewer. ``surface`` [H, W], metres,
    or None: the mean depth of the contributors within NEAR_MEDIAN of the median one, at which half of ``alpha`` is
    reached; 0 where nothing is drawn."""

    image: Tensor
    labels: Tensor | None
    alpha: Tensor
    depth: Tensor
    visible: Tensor
    means2d: Tensor
    top_indices: Tensor | None = None
    top_weights: Tensor | None = None
    surface: Tensor | None = None
