"""Scenes that are hard on a rasteriser, and the comparison of two back ends on them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from engine.raster import Rendering
from engine.raster.conventions import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_END
from engine.raster.interface import _pinhole
from tests.raster.reference import footprint_visible, project, rasterize, raw_alphas

GROUPS = ("means", "scales", "quats", "opacities", "colours", "labels", "means2d")
LAYERS = ("image", "labels", "alpha", "depth")


@dataclass(frozen=True, eq=False)
class Scene:
    tensors: tuple[Tensor, ...]
    pose: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    width: int
    height: int

    def changed(self, number: int, values: Tensor) -> Scene:
        tensors = list(self.tensors)
        tensors[number] = values
        return replace(self, tensors=tuple(tensors))


def random_scene(seed: int, count: int, channels: int, width: int, height: int) -> Scene:
    """Gaussians before, beside and behind a turned camera with an off-centre principal point and unequal
    focal lengths."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    means = torch.stack([(uniform(count) - 0.5) * 4, (uniform(count) - 0.5) * 4, uniform(count) * 5 - 0.5], -1)
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
    long_needles = needles.clone()
    long_needles[:, 2] = 3.0
    return {
        "mixed": mixed,
        "many labels": random_scene(1, 600, 46, 48, 32),
        "wide labels": random_scene(2, 200, 70, 20, 17),
        "one pixel": random_scene(4, 50, 2, 1, 1),
        "huge": mixed.changed(1, mixed.tensors[1] * 30.0),
        "tiny": mixed.changed(1, mixed.tensors[1] * 1e-3),
        "flat": mixed.changed(1, thin),
        "needles": mixed.changed(1, needles),
        "long needles": mixed.changed(1, long_needles),
        "edge-on discs": edge_on_discs(mixed),
        "across the near plane": across_the_near_plane(mixed),
        "long lists": long_lists(),
        "partly saturated": partly_saturated(opaque),
        "saturated": opaque.changed(3, torch.full_like(opaque.tensors[3], 1.0)),
        "faint": mixed.changed(3, mixed.tensors[3] * 0.02 - 0.004),
        "far off centre": replace(mixed, intrinsics=np.array([[30.0, 0, -20.0], [0, 30.0, 50.0], [0, 0, 1]])),
    }


def scenes_by_channels() -> dict[str, Scene]:
    """Label counts around the kernels' vectors of 16 and blocks of 48, and rows of labels that begin at cache lines (a
    width that is a multiple of 16) or anywhere."""
    scenes = {f"{channels} labels": random_scene(2, 150, channels, 35, 20) for channels in (1, 16, 17, 48, 200)}
    scenes["46 labels, rows at cache lines"] = random_scene(1, 200, 46, 64, 33)
    scenes["46 labels, rows anywhere"] = random_scene(3, 200, 46, 45, 33)
    return scenes


def edge_on_discs(scene: Scene) -> Scene:
    """Discs of no thickness whose plane holds the camera's centre."""
    means, scales = scene.tensors[0].double(), scene.tensors[1].clone()
    rays = means - torch.from_numpy(scene.pose[:3, 3])
    normals = torch.linalg.cross(rays, rays.flip(1) + 0.1)
    normals /= normals.norm(dim=1, keepdim=True)
    # the rotation that takes z to the normal: half-way between the two
    x, y, z = normals.unbind(1)
    quats = torch.stack([1.0 + z, -y, x, torch.zeros_like(z)], -1)
    scales[:, 2] = 1e-6
    return scene.changed(1, scales).changed(2, quats.float())


def across_the_near_plane(scene: Scene) -> Scene:
    """Centres from before the near plane to five times its depth, with footprints on both sides of it."""
    count = len(scene.tensors[0])
    generator = torch.Generator().manual_seed(11)
    depth = torch.rand(count, generator=generator) * 0.05
    beside = (torch.rand(count, 2, generator=generator) - 0.5) * 2.0 * depth[:, None]
    at_camera = torch.cat([beside, depth[:, None]], 1).double().numpy()
    means = at_camera @ scene.pose[:3, :3].T + scene.pose[:3, 3]
    near = scene.changed(0, torch.from_numpy(means).float())
    return near.changed(1, scene.tensors[1] * 0.2).changed(3, scene.tensors[3] * 0.2)


def long_lists(seed: int = 12) -> Scene:
    """A thousand visible Gaussians on each tile: many chunks, the last one not full."""
    scene = random_scene(seed, 1000, 5, 20, 17)
    generator = torch.Generator().manual_seed(seed)
    beside = torch.rand(1000, 2, generator=generator) - 0.5
    depth = 2.0 + torch.rand(1000, 1, generator=generator)
    means = torch.cat([beside, depth], 1).double().numpy() @ scene.pose[:3, :3].T + scene.pose[:3, 3]
    faint = 0.005 + 0.01 * torch.rand(1000, generator=generator)
    return scene.changed(0, torch.from_numpy(means).float()).changed(1, scene.tensors[1] + 0.5).changed(3, faint)


def partly_saturated(scene: Scene) -> Scene:
    """Closed on one side by few Gaussians, open on the other: the pixels of a row end at different depths."""
    opacities = torch.where(scene.tensors[0][:, 0] < 0.0, 1.0, 0.02)
    return scene.changed(3, opacities).changed(1, scene.tensors[1] * 3.0)


def steady_pixels(scene: Scene) -> Tensor:
    """bool [H, W]: no threshold is so near that float32 might decide otherwise."""
    means, scales, quats, opacities = (tensor.double() for tensor in scene.tensors[:4])
    pinhole = _pinhole(scene.pose, scene.intrinsics, scene.width, scene.height, near=0.01)
    centres, covariances, depths = project(means, scales, quats, pinhole)
    shown = torch.nonzero(footprint_visible(centres, covariances, depths, opacities.clamp(min=ALPHA_MIN), pinhole))[
        :, 0
    ]
    order = shown[torch.sort(depths[shown].float(), stable=True).indices]
    near = threshold_pixels(raw_alphas(centres[order], covariances[order], opacities[order], pinhole))
    return ~near.reshape(scene.height, scene.width)


def render(
    scene: Scene, backend: str, where: Tensor | None = None, layers: tuple[str, ...] = LAYERS
) -> tuple[Rendering, dict[str, Tensor]]:
    """The rendering, and the gradients of a fixed random loss over these layers of the pixels ``where``."""
    tensors = [tensor.clone().requires_grad_() for tensor in scene.tensors]
    out = rasterize(
        *tensors, scene.pose, scene.intrinsics, scene.width, scene.height, backend=backend, want_means2d_grad=True
    )
    generator = torch.Generator().manual_seed(1)
    kept = torch.ones(scene.height, scene.width) if where is None else where.float()
    loss = torch.zeros((), dtype=torch.float64, device=out.image.device)
    for name in LAYERS:
        layer = getattr(out, name)
        by = torch.randn(layer.shape, generator=generator) * (kept if layer.ndim == 2 else kept[:, :, None])
        if name not in layers:
            continue
        loss = loss + (layer.double() * by.to(layer.device)).sum()
    loss.backward()
    return out, dict(zip(GROUPS, [*(tensor.grad for tensor in tensors), out.means2d.grad], strict=True))


def missed_elements(got: Tensor, expected: Tensor) -> int:
    """The number of elements with |err| > 1e-3 |ref| + 1e-6 rms."""
    got, expected = got.double(), expected.double()
    if expected.numel() == 0:
        return 0
    rms = expected.pow(2).mean().sqrt()
    return int(((got - expected).abs() > 1e-3 * expected.abs() + 1e-6 * rms).sum())


def threshold_pixels(raw: Tensor, margin: float = 1e-5) -> Tensor:
    """bool [H * W]: float32 may decide otherwise here, as something is near a threshold: within ``margin`` (relative)
    for an alpha, a hundred times that for a transmittance, whose error is so much larger behind an alpha near 0.99."""
    alpha = raw.clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1.0 - alpha, 0)

    def close(values: Tensor, threshold: float, factor: float = 1.0) -> Tensor:
        return ((values / threshold - 1.0).abs() < factor * margin).any(0)

    return close(raw, ALPHA_MIN) | close(raw, ALPHA_MAX) | close(after, TRANSMITTANCE_END, 100.0)


def assert_same_bits_with_any_threads(scene: Scene, backend: str) -> None:
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3, 3, 1):
            torch.set_num_threads(threads)
            results.append(render(scene, backend))
    finally:
        torch.set_num_threads(before)
    for out, gradients in results[1:]:
        for layer in LAYERS:
            assert torch.equal(getattr(out, layer), getattr(results[0][0], layer)), layer
        for group in GROUPS:
            assert torch.equal(gradients[group], results[0][1][group]), group


def assert_labels_affect_nothing_else(backend: str) -> None:
    scene = random_scene(6, 100, 4, 30, 20)
    tensors = [tensor.clone().requires_grad_() for tensor in scene.tensors]
    out = rasterize(*tensors, scene.pose, scene.intrinsics, 30, 20, backend=backend, want_means2d_grad=True)
    assert out.labels is not None
    out.labels.square().sum().backward()
    for tensor in (*tensors[:5], out.means2d):
        assert tensor.grad is None or not tensor.grad.any()
    assert tensors[5].grad is not None and tensors[5].grad.any()
