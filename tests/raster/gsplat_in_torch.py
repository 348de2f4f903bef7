"""``gsplat.rasterization`` on a CPU: a stand-in that needs no gsplat, and gsplat's own with its torch operators."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from engine.raster import interface
from engine.raster.conventions import ALPHA_MIN, BLUR, TRANSMITTANCE_END, Pinhole
from engine.raster.reference import blending_weights, footprint_visible, project, raw_alphas


def rasterization(
    *,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,  # noqa: N803 (gsplat's name)
    width: int,
    height: int,
    near_plane: float,
    eps2d: float,
    packed: bool,
    render_mode: str,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """gsplat's call with the reference's arithmetic, for one camera and what is not ``packed``."""
    assert eps2d == BLUR and not packed
    pose, (fx, _, cx, _, fy, cy, *_) = viewmats[0].double(), Ks[0].double().flatten().tolist()
    rotation, centre = pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
    pinhole = Pinhole(
        tuple(rotation.flatten().tolist()), tuple(centre.tolist()), (fx, fy), (cx, cy), width, height, near_plane
    )
    centres, covariances, depths = project(means.double(), scales.double(), quats.double(), pinhole)
    means2d = centres[None].to(means)
    centres = means2d[0].double()
    visible = footprint_visible(
        centres.detach(), covariances.detach(), depths.detach(), opacities.detach().double(), pinhole
    )
    chosen = visible.nonzero()[:, 0]
    order = chosen[torch.sort(depths.detach()[chosen].float(), stable=True).indices]
    weights = blending_weights(raw_alphas(centres[order], covariances[order], opacities[order].double(), pinhole))
    channels = torch.cat([colors, depths[:, None]], 1) if render_mode == "RGB+D" else colors
    drawn = (weights.T @ channels[order].double()).view(1, height, width, -1)
    alpha = weights.sum(0).view(1, height, width, 1)
    reach = (2.0 * (opacities.detach().double() / ALPHA_MIN).clamp(min=1.0).log()).sqrt()
    deviations = covariances.detach().diagonal(dim1=-2, dim2=-1).sqrt()
    radii = (visible[:, None] * (reach[:, None] * deviations).ceil()).int()[None]
    return drawn.to(means), alpha.to(means), {"radii": radii, "means2d": means2d}


def _blend_tiles(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    width: int,
    height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    **_: Any,
) -> tuple[Tensor, Tensor]:
    """What gsplat 1.5's CUDA kernel makes of its lists. (Its torch counterpart needs CUDA itself.)"""
    starts = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    drawn, alphas = torch.zeros(height, width, colors.shape[-1]), torch.zeros(height, width, 1)
    for tile, (first, end) in enumerate(zip(starts, starts[1:], strict=False)):
        row, column = divmod(tile, isect_offsets.shape[-1])
        ys = torch.arange(row * tile_size, min((row + 1) * tile_size, height))
        xs = torch.arange(column * tile_size, min((column + 1) * tile_size, width))
        ids = flatten_ids[first:end].long()
        dy, dx = (ys[:, None, None] + 0.5 - means2d[0, ids, 1]), (xs[None, :, None] + 0.5 - means2d[0, ids, 0])
        a, b, c = conics[0, ids].unbind(-1)
        alpha = (opacities[0, ids] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp(max=0.999)
        alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
        after = torch.cumprod(1.0 - alpha, -1)
        before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)[..., : len(ids)]
        weights = torch.where(after > TRANSMITTANCE_END, alpha * before, 0.0)
        place = (ys[:, None].expand(-1, len(xs)), xs[None].expand(len(ys), -1))
        drawn = drawn.index_put(place, weights @ colors[0, ids])
        alphas = alphas.index_put(place, weights.sum(-1, keepdim=True))
    return drawn[None], alphas[None]


def use_gsplats_torch_operators(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let ``gsplat.rasterization`` itself run on a CPU; skips the test where gsplat is not installed."""
    rendering = pytest.importorskip("gsplat.rendering", reason="gsplat is not installed")
    from gsplat.cuda import _torch_impl

    def project_in_torch(
        means: Tensor, covars: None, quats: Tensor, scales: Tensor, *camera: Any, **options: Any
    ) -> tuple[Tensor, ...]:
        covars, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        chosen = {name: options[name] for name in ("eps2d", "near_plane", "far_plane")}
        radii, means2d, depths, conics, none = _torch_impl._fully_fused_projection(means, covars, *camera, **chosen)
        return radii, means2d, depths, conics, none

    def isect_tiles(means2d: Tensor, radii: Tensor, depths: Tensor, *tiles: int, **_: Any) -> tuple[Tensor, ...]:
        return _torch_impl._isect_tiles(means2d.detach(), radii, depths.detach(), *tiles)

    monkeypatch.setattr(rendering, "fully_fused_projection", project_in_torch)
    monkeypatch.setattr(rendering, "isect_tiles", isect_tiles)
    monkeypatch.setattr(rendering, "isect_offset_encode", _torch_impl._isect_offset_encode)
    monkeypatch.setattr(rendering, "rasterize_to_pixels", _blend_tiles)
    draw_on_the_cpu(monkeypatch)


def use_a_stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the stand-in above in the place of gsplat."""
    gsplat = ModuleType("gsplat")
    gsplat.rasterization = rasterization  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gsplat", gsplat)
    draw_on_the_cpu(monkeypatch)


def draw_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the back end gsplat take tensors that are on the CPU."""
    monkeypatch.setattr(interface, "_pick", lambda backend, means: backend)
