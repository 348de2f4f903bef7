"""Scenes that are hard on a rasteriser, and the comparison of two back ends on them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from engine.raster import Rendering, rasterize
from engine.raster.conventions import ALPHA_MIN
from engine.raster.interface import _view
from engine.raster.reference import footprint_visible, project, raw_alphas, threshold_pixels

GROUPS = ("means", "scales", "quats", "opacities", "colours", "labels", "means2d")
LAYERS = ("image", "labels", "alpha", "depth")


@dataclass(frozen=True, eq=False)
class Scene:
    tensors: tuple[Tensor, ...]
    pose: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    width: int
    height: int

    def changed(self, place: int, values: Tensor) -> Scene:
        tensors = list(self.tensors)
        tensors[place] = values
        return replace(self, tensors=tuple(tensors))


def random_scene(seed: int, count: int, channels: int, width: int, height: int) -> Scene:
    """Gaussians before, beside and behind a turned camera with an off-centre principal point and unequal
    focal lengths."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    means = torch.stack(
        [(uniform(count) - 0.5) * 4, (uniform(count) - 0.5) * 4, uniform(count) * 5 - 0.5], -1
    )
    scales = torch.exp(torch.randn(count, 3, generator=generator) - 2.5)
    quats = torch.randn(count, 4, generator=generator)
    tensors = (means, scales, quats, uniform(count), uniform(count, 3), uniform(count, channels))
    angle = 0.1 * (seed + 1)
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [0.1, -0.2, 0.05]
    intrinsics = np.array([[width * 0.9, 0, width * 0.43], [0, width * 1.0, height * 0.58], [0, 0, 1]])
    return Scene(tensors, pose, intrinsics, width, height)


def hard_scenes() -> dict[str, Scene]:
    mixed = random_scene(0, 250, 5, 37, 29)
    opaque = random_scene(3, 400, 3, 33, 48)
    thin = mixed.tensors[1].clone()
    thin[:, 0] = 1e-6
    needles = mixed.tensors[1].clone()
    needles[:, :2] = 1e-5
    needles[:, 2] = 0.7
    return {
        "mixed": mixed,
        "many labels": random_scene(1, 600, 46, 48, 32),
        "wide labels": random_scene(2, 200, 70, 20, 17),
        "one pixel": random_scene(4, 50, 2, 1, 1),
        "huge": mixed.changed(1, mixed.tensors[1] * 30.0),
        "tiny": mixed.changed(1, mixed.tensors[1] * 1e-3),
        "flat": mixed.changed(1, thin),
        "needles": mixed.changed(1, needles),
        "saturated": opaque.changed(3, torch.full_like(opaque.tensors[3], 1.0)),
        "faint": mixed.changed(3, mixed.tensors[3] * 0.02 - 0.004),
        "far off centre": replace(mixed, intrinsics=np.array([[30.0, 0, -20.0], [0, 30.0, 50.0], [0, 0, 1]])),
    }


def steady_pixels(scene: Scene) -> Tensor:
    """bool [H, W]: no threshold is so near that float32 might decide otherwise."""
    means, scales, quats, opacities = (tensor.double() for tensor in scene.tensors[:4])
    view = _view(scene.pose, scene.intrinsics, scene.width, scene.height, 0.01)
    centres, covariances, depths = project(means, scales, quats, view)
    shown = torch.nonzero(
        footprint_visible(centres, covariances, depths, opacities.clamp(min=ALPHA_MIN), view)
    )[:, 0]
    order = shown[torch.sort(depths[shown].float(), stable=True).indices]
    near = threshold_pixels(raw_alphas(centres[order], covariances[order], opacities[order], view))
    return ~near.reshape(scene.height, scene.width)


def render(scene: Scene, backend: str, where: Tensor | None = None) -> tuple[Rendering, dict[str, Tensor]]:
    """The rendering, and the gradients of a fixed random loss over all four layers of the pixels
    ``where``."""
    tensors = [tensor.clone().requires_grad_() for tensor in scene.tensors]
    out = rasterize(
        *tensors,
        scene.pose,
        scene.intrinsics,
        scene.width,
        scene.height,
        backend=backend,
        want_means2d_grad=True,
    )
    generator = torch.Generator().manual_seed(1)
    kept = torch.ones(scene.height, scene.width) if where is None else where.float()
    loss = torch.zeros((), dtype=torch.float64, device=out.image.device)
    for name in LAYERS:
        layer = getattr(out, name)
        by = torch.randn(layer.shape, generator=generator) * (kept if layer.ndim == 2 else kept[:, :, None])
        loss = loss + (layer.double() * by.to(layer.device)).sum()
    loss.backward()
    return out, dict(zip(GROUPS, [*(tensor.grad for tensor in tensors), out.means2d.grad], strict=True))


def missed_share(got: Tensor, expected: Tensor) -> float:
    """Share of elements with |err| > 1e-3 |ref| + 1e-6 rms."""
    got, expected = got.double(), expected.double()
    if expected.numel() == 0:
        return 0.0
    rms = expected.pow(2).mean().sqrt()
    return ((got - expected).abs() > 1e-3 * expected.abs() + 1e-6 * rms).double().mean().item()
