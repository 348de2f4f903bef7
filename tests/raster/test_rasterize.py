"""The back end numba against the float64 reference."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from engine.raster import Rendering, rasterize

GROUPS = ("means", "scales", "quats", "opacities", "colours", "labels", "means2d")


def room(seed: int, count: int, channels: int, width: int, height: int):
    """Random Gaussians before, beside and behind an off-centre camera with unequal focal lengths."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    means = torch.stack(
        [(uniform(count) - 0.5) * 4, (uniform(count) - 0.5) * 4, uniform(count) * 5 - 0.5], -1
    )
    scales = torch.exp(torch.randn(count, 3, generator=generator) - 2.5)
    quats = torch.randn(count, 4, generator=generator)
    tensors = [means, scales, quats, uniform(count), uniform(count, 3), uniform(count, channels)]
    intrinsics = np.array([[width * 0.9, 0, width * 0.43], [0, width * 1.0, height * 0.58], [0, 0, 1]])
    return tensors, np.eye(4), intrinsics, width, height


def render(scene, backend: str) -> tuple[Rendering, dict[str, torch.Tensor]]:
    tensors, pose, intrinsics, width, height = scene
    tensors = [tensor.clone().requires_grad_() for tensor in tensors]
    out = rasterize(*tensors, pose, intrinsics, width, height, backend=backend, want_means2d_grad=True)
    generator = torch.Generator().manual_seed(1)
    loss = torch.zeros((), dtype=torch.float64)
    for layer in (out.image, out.labels, out.alpha, out.depth):
        loss = loss + (layer * torch.randn(layer.shape, generator=generator)).double().sum()
    loss.backward()
    return out, dict(zip(GROUPS, [*(tensor.grad for tensor in tensors), out.means2d.grad], strict=True))


@pytest.mark.parametrize(
    ("seed", "count", "channels", "width", "height"), [(0, 200, 5, 37, 29), (1, 800, 46, 48, 32)]
)
def test_matches_the_reference(seed: int, count: int, channels: int, width: int, height: int) -> None:
    scene = room(seed, count, channels, width, height)
    ours, our_gradients = render(scene, "numba")
    theirs, their_gradients = render(scene, "reference")
    assert torch.equal(ours.visible, theirs.visible)
    for name in ("image", "labels", "alpha", "depth"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=0, atol=1e-5)
    for name in GROUPS:
        got, expected = our_gradients[name].double(), their_gradients[name].double()
        rms = expected.pow(2).mean().sqrt()
        missed = (got - expected).abs() > 1e-3 * expected.abs() + 1e-6 * rms
        assert missed.double().mean() <= 1e-4, name


@pytest.mark.parametrize("backend", ["numba", "reference"])
@pytest.mark.parametrize("count", [0, 3])
def test_nothing_to_see(backend: str, count: int) -> None:
    tensors, pose, intrinsics, width, height = room(0, count, 4, 20, 20)
    tensors[0][:, 2] = -1.0
    out, gradients = render((tensors, pose, intrinsics, width, height), backend)
    assert not out.visible.any()
    for name in ("image", "labels", "alpha", "depth"):
        assert not getattr(out, name).any()
    assert not any(gradient.any() for gradient in gradients.values())
