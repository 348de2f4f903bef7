"""``gsplat.rasterization`` on a CPU: a stand-in that needs no gsplat."""

import sys
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from engine.raster import cuda, interface
from engine.raster.conventions import ALPHA_MAX, ALPHA_MIN, BLUR, TRANSMITTANCE_END, Pinhole
from tests.raster.reference import blending_weights, footprint_visible, project, raw_alphas


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
    tile_size: int,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """gsplat's call with the reference's arithmetic, for one camera and without ``packed``."""
    assert eps2d == BLUR and not packed and render_mode == "RGB+D"
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
    channels = torch.cat([colors, depths[:, None]], 1)
    drawn = (weights.T @ channels[order].double()).view(1, height, width, -1)
    alpha = weights.sum(0).view(1, height, width, 1)
    reach = (2.0 * (opacities.detach().double() / ALPHA_MIN).clamp(min=1.0).log()).sqrt()
    deviations = covariances.detach().diagonal(dim1=-2, dim2=-1).sqrt()
    radii = (visible[:, None] * (reach[:, None] * deviations).ceil()).int()[None]
    inverse = torch.linalg.inv(covariances.detach())
    about = {
        "radii": radii,
        "means2d": means2d,
        "conics": torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], dim=1)[None].to(means),
        "opacities": opacities[None],
        "tile_size": tile_size,
        "isect_offsets": None,
        "flatten_ids": order,
    }
    return drawn.to(means), alpha.to(means), about


def rasterize_to_indices_in_range(
    first: int, end: int, light: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor, width: int, height: int,
    tile_size: int, isect_offsets: None, flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """gsplat's call for the lists of one tile: what each pixel shows, pixel by pixel, front to back."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    centres = means2d[0, flatten_ids].double()
    dx, dy = centres[:, 0] - x.reshape(-1, 1), centres[:, 1] - y.reshape(-1, 1)
    a, b, c = conics[0, flatten_ids].double().unbind(-1)
    alpha = opacities[0, flatten_ids] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha.clamp(max=ALPHA_MAX), 0.0)
    goes_on = torch.cumprod(1.0 - alpha, 1) > TRANSMITTANCE_END
    pixel, index = ((alpha > 0) & goes_on).nonzero().unbind(1)
    return flatten_ids[index], pixel, torch.zeros_like(pixel)


def use_a_stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace gsplat by the stand-in above."""
    gsplat = ModuleType("gsplat")
    gsplat.rasterization = rasterization  # type: ignore[attr-defined]
    gsplat.rasterize_to_indices_in_range = rasterize_to_indices_in_range  # type: ignore[attr-defined]
    monkeypatch.setattr(cuda, "alpha_cap", lambda: ALPHA_MAX)
    monkeypatch.setitem(sys.modules, "gsplat", gsplat)
    # The back end takes tensors that are on the CPU.
    monkeypatch.setattr(interface, "_pick", lambda backend, means: backend)
