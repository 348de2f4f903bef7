"""The oracle: every Gaussian is evaluated at every pixel, in float64, with torch's autograd.

Memory and time grow with N * H * W."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from engine.raster import Rendering, interface
from engine.raster.conventions import ALPHA_MAX, ALPHA_MIN, BLUR, NEAR, TINY_NORM, TRANSMITTANCE_END, Pinhole
from engine.raster.rendering import GaussianSet, Wanted


def rasterize(*arguments: Any, backend: str | None = None, **options: Any) -> Rendering:
    """As the engine's, with one more back end: ``reference``, which finds no surface."""
    if backend != "reference":
        return interface.rasterize(*arguments, backend=backend, **options)
    camera = {name: options[name] for name in ("rows", "is_orthographic") if name in options}
    pinhole = interface._pinhole(*arguments[6:], near=options.get("near", NEAR), **camera)
    wanted = Wanted(options.get("top_k", 0), False, options.get("want_means2d_grad", False))
    return rasterize_reference(GaussianSet(*arguments[:6]), pinhole, wanted)


def rasterize_reference(gaussians: GaussianSet, pinhole: Pinhole, wanted: Wanted) -> Rendering:
    """``rasterize``, computed in float64 for input of any dtype; the result has the input's dtype."""
    dtype, labels = gaussians.means.dtype, gaussians.labels
    means, scales, quats, opacities, colours = (tensor.double() for tensor in gaussians[:5])
    centres, covariances, depths = project(means, scales, quats, pinhole)
    handle = centres.detach().clone().requires_grad_(wanted.means2d_grad)
    # the value stays the same, and the gradient reaches both
    centres = centres + (handle - handle.detach())
    visible = footprint_visible(centres.detach(), covariances.detach(), depths.detach(), opacities.detach(), pinhole)
    # the order that all back ends share: depth rounded to float32, ties by index
    chosen = torch.nonzero(visible)[:, 0]
    order = chosen[torch.sort(depths.detach()[chosen].float(), stable=True).indices]
    weights = blending_weights(raw_alphas(centres[order], covariances[order], opacities[order], pinhole))

    def blend(values: Tensor, by: Tensor) -> Tensor:
        return (by.T @ values[order]).reshape(pinhole.height, pinhole.width, -1).to(dtype)

    with torch.no_grad():
        handle[~visible] = 0.0
    top_indices, top_weights = top_contributors(weights.detach(), order, pinhole, wanted.top_k)
    return Rendering(
        image=blend(colours, weights),
        labels=None if labels is None else blend(labels.double(), weights.detach()),
        alpha=weights.sum(0).reshape(pinhole.height, pinhole.width).to(dtype),
        depth=blend(depths[:, None], weights)[:, :, 0],
        visible=visible,
        means2d=handle,
        top_indices=top_indices,
        top_weights=None if top_weights is None else top_weights.to(dtype),
    )


def project(
    means: Tensor,  # [N, 3]
    scales: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    pinhole: Pinhole,
) -> tuple[Tensor, Tensor, Tensor]:
    """Centres [N, 2] in pixels, blurred 2D covariances [N, 2, 2] in pixels squared, planar depths [N] in metres. Rows
    at or behind the near plane are computed for a point at depth 1, so that no infinity enters the gradients."""
    rotation = torch.as_tensor(pinhole.rotation, dtype=means.dtype).reshape(3, 3)
    centre = torch.as_tensor(pinhole.centre, dtype=means.dtype)
    x, y, z = ((means - centre) @ rotation.T).unbind(-1)
    safe = torch.where(z > pinhole.near, z, torch.ones_like(z))
    if pinhole.is_orthographic:
        safe = torch.ones_like(z)
    (fx, fy), (cx, cy) = pinhole.focal, pinhole.principal
    x_low, x_high, y_low, y_high = pinhole.slope_limits()
    u = torch.clamp(x / safe, x_low, x_high)
    v = torch.clamp(y / safe, y_low, y_high)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / safe, zero, -fx * u / safe], -1), torch.stack([zero, fy / safe, -fy * v / safe], -1)], -2
    )
    spread = jacobian @ rotation @ (rotation_matrices(quats) * scales[:, None, :])
    covariances = spread @ spread.transpose(-1, -2) + BLUR * torch.eye(2, dtype=means.dtype)
    centres = torch.stack([fx * x / safe + cx, fy * y / safe + cy], -1)
    return centres, covariances, z


def rotation_matrices(
    quats: Tensor,  # [N, 4], wxyz of any length
) -> Tensor:
    """The rotation matrix of each quaternion, [N, 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1, eps=TINY_NORM).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def footprint_visible(
    centres: Tensor,  # [N, 2], pixels
    covariances: Tensor,  # [N, 2, 2]
    depths: Tensor,  # [N], metres
    opacities: Tensor,  # [N]
    pinhole: Pinhole,
) -> Tensor:
    """bool [N]: beyond the near plane, and the box around {alpha >= 1/255} contains a pixel centre of the image."""
    reach = 2.0 * torch.log(opacities.clamp(min=1e-30) / ALPHA_MIN)  # no logarithm of 0
    extent = torch.sqrt(reach.clamp(min=0.0)[:, None] * torch.diagonal(covariances, dim1=-2, dim2=-1))
    size = torch.tensor([pinhole.width, pinhole.height], dtype=centres.dtype)
    first = torch.ceil(centres - extent - 0.5).clamp(min=0.0)
    last = torch.minimum(torch.floor(centres + extent - 0.5), size - 1.0)
    return (depths > pinhole.near) & (opacities >= ALPHA_MIN) & (first <= last).all(-1)


def raw_alphas(
    centres: Tensor,  # [n, 2], pixels
    covariances: Tensor,  # [n, 2, 2]
    opacities: Tensor,  # [n]
    pinhole: Pinhole,
) -> Tensor:
    """[n, H * W]: opacity * exp(-d^2 / 2), neither capped nor cut."""
    rows, columns = torch.meshgrid(
        torch.arange(pinhole.height, dtype=centres.dtype) + 0.5,
        torch.arange(pinhole.width, dtype=centres.dtype) + 0.5,
        indexing="ij",
    )
    dx = columns.reshape(1, -1) - centres[:, 0:1]
    dy = rows.reshape(1, -1) - centres[:, 1:2]
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    determinant = a * c - b * b
    distance = (c[:, None] * dx * dx - 2.0 * b[:, None] * dx * dy + a[:, None] * dy * dy) / determinant[:, None]
    return opacities[:, None] * torch.exp(-0.5 * distance)


def blending_weights(
    raw: Tensor,  # [n, H * W], of ``raw_alphas``
) -> Tensor:
    """[n, H * W] weights of n Gaussians in front-to-back order."""
    alpha = raw.clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1.0 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    return torch.where(after > TRANSMITTANCE_END, alpha * before, torch.zeros_like(alpha))


def top_contributors(
    weights: Tensor,  # [n, H * W]
    order: Tensor,  # int64 [n]
    pinhole: Pinhole,
    top_k: int,
) -> tuple[Tensor | None, Tensor | None]:
    """int32 [H, W, k] Gaussian indices and [H, W, k] weights, largest first; -1 and 0 where there are fewer."""
    if top_k == 0:
        return None, None
    count = min(top_k, weights.shape[0])
    # a stable sort, so that of two equal weights the one in front comes first
    values, ranks = torch.sort(weights.T, dim=1, descending=True, stable=True)
    values, ranks = values[:, :count], ranks[:, :count]
    indices = torch.where(values > 0.0, order[ranks], -torch.ones_like(ranks))
    missing = (0, top_k - count)
    indices = torch.nn.functional.pad(indices, missing, value=-1)
    values = torch.nn.functional.pad(values, missing, value=0.0)
    shape = (pinhole.height, pinhole.width, top_k)
    return indices.to(torch.int32).reshape(shape), values.reshape(shape)
