"""``gsplat.rasterization`` on a CPU: a stand-in that needs no gsplat."""

from __future__ import annotations

import sys
from types import ModuleType

import pytest
import torch
from torch import Tensor

from engine.raster import interface
from engine.raster.conventions import ALPHA_MIN, BLUR, Pinhole
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


def use_a_stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the stand-in above in the place of gsplat."""
    gsplat = ModuleType("gsplat")
    gsplat.rasterization = rasterization  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gsplat", gsplat)
    draw_on_the_cpu(monkeypatch)


def draw_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the back end gsplat take tensors that are on the CPU."""
    monkeypatch.setattr(interface, "_pick", lambda backend, means: backend)
