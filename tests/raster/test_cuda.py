"""The back end gsplat against the float64 reference: without gsplat everywhere, with gsplat's own torch operators where
it is installed, as it is where there is a GPU too."""

from __future__ import annotations

from dataclasses import replace
from importlib import metadata

import pytest
import torch
from scenes import (
    GROUPS,
    LAYERS,
    Scene,
    assert_same_bits_with_any_threads,
    hard_scenes,
    missed_share,
    random_scene,
    render,
    steady_pixels,
)
from torch import Tensor

from engine.raster import cuda, interface, rasterize
from engine.raster.blending import torch_tiles
from tests.raster.plain_tile_lists import list_tiles_plainly

SCENES = hard_scenes()


@pytest.fixture(params=["plain lists", "gsplat's torch operators"])
def on_the_cpu(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets the back end draw tensors on the CPU, with something in the place of gsplat's CUDA operators."""
    monkeypatch.setattr(interface, "_pick", lambda backend, means: backend)
    if request.param == "plain lists":
        monkeypatch.setattr(cuda, "list_by_gsplat", list_tiles_plainly)
        return
    gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed")
    from gsplat.cuda import _torch_impl

    monkeypatch.setattr(gsplat, "isect_tiles", _torch_impl._isect_tiles)
    monkeypatch.setattr(gsplat, "isect_offset_encode", _torch_impl._isect_offset_encode)


def assert_as_the_reference(scene: Scene, device: str = "cpu") -> None:
    steady = steady_pixels(scene)
    assert steady.float().mean() > 0.9
    there = replace(scene, tensors=tuple(tensor.to(device) for tensor in scene.tensors))
    ours, our_gradients = render(there, "gsplat", steady)
    theirs, their_gradients = render(scene, "reference", steady)
    assert torch.equal(ours.visible.cpu(), theirs.visible)
    torch.testing.assert_close(ours.means2d.cpu(), theirs.means2d.float(), rtol=1e-6, atol=1e-4)
    for layer in LAYERS:
        got, expected = getattr(ours, layer).cpu()[steady], getattr(theirs, layer)[steady]
        torch.testing.assert_close(got, expected, rtol=0, atol=1e-5, msg=lambda text, layer=layer: f"{layer}: {text}")
    for group in GROUPS:
        assert missed_share(our_gradients[group].cpu(), their_gradients[group]) <= 1e-4, group


@pytest.mark.usefixtures("on_the_cpu")
@pytest.mark.parametrize("name", SCENES)
def test_matches_the_reference(name: str) -> None:
    assert_as_the_reference(SCENES[name])


@pytest.mark.usefixtures("on_the_cpu")
@pytest.mark.parametrize("name", ["mixed", "saturated"])
def test_matches_the_reference_in_many_passes(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_tiles, "PAIRS_AT_ONCE", 3 * 6 * torch_tiles.PIXELS)
    assert_as_the_reference(SCENES[name])


def test_the_same_bits_with_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interface, "_pick", lambda backend, means: backend)
    monkeypatch.setattr(cuda, "list_by_gsplat", list_tiles_plainly)
    scene = random_scene(5, 500, 20, 70, 50)
    assert_same_bits_with_any_threads(scene, "gsplat")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.skipif(cuda.what_is_missing() is not None, reason=str(cuda.what_is_missing()))
@pytest.mark.parametrize("name", SCENES)
def test_matches_the_reference_on_a_gpu(name: str) -> None:
    assert_as_the_reference(SCENES[name], "cuda")


@pytest.mark.usefixtures("on_the_cpu")
@pytest.mark.parametrize("count", [0, 3])
def test_nothing_to_see(count: int) -> None:
    scene = random_scene(0, count, 4, 20, 20)
    means = scene.tensors[0].clone()
    means[:, 2] = -5.0
    out, gradients = render(scene.changed(0, means), "gsplat")
    assert not out.visible.any()
    for layer in LAYERS:
        assert not getattr(out, layer).any()
    assert not any(gradient.any() for gradient in gradients.values())


@pytest.mark.usefixtures("on_the_cpu")
def test_labels_touch_nothing_but_themselves() -> None:
    scene = random_scene(6, 100, 4, 30, 20)
    tensors = [tensor.clone().requires_grad_() for tensor in scene.tensors]
    out = rasterize(*tensors, scene.pose, scene.intrinsics, 30, 20, backend="gsplat", want_means2d_grad=True)
    assert out.labels is not None
    out.labels.square().sum().backward()
    for tensor in (*tensors[:5], out.means2d):
        assert tensor.grad is None or not tensor.grad.any()
    assert tensors[5].grad is not None and tensors[5].grad.any()


@pytest.mark.usefixtures("on_the_cpu")
@pytest.mark.parametrize("pairs_at_once", [1 << 23, 4 * 6 * torch_tiles.PIXELS])
@pytest.mark.parametrize("top_k", [1, 3, 500])
def test_top_contributors(top_k: int, pairs_at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_tiles, "PAIRS_AT_ONCE", pairs_at_once)
    scene = random_scene(8, 200, 2, 35, 21)
    where = (*scene.tensors[:5], None, scene.pose, scene.intrinsics, 35, 21)
    ours, theirs = (rasterize(*where, top_k=top_k, backend=backend) for backend in ("gsplat", "reference"))
    steady = steady_pixels(scene)
    torch.testing.assert_close(ours.top_weights[steady], theirs.top_weights[steady], rtol=0, atol=1e-5)
    assert ours.top_indices.dtype == torch.int32
    assert (ours.top_indices != theirs.top_indices)[steady].float().mean() < 1e-3  # equal weights may swap
    assert torch.equal(ours.top_indices >= 0, ours.top_weights > 0.0)
    assert ours.labels is None


@pytest.mark.usefixtures("on_the_cpu")
def test_gradcheck_in_float64() -> None:
    scene = random_scene(9, 4, 2, 4, 3)
    means = torch.tensor([[0.1, 0.0, 2.0], [-0.3, 0.1, 2.5], [0.2, -0.2, 3.0], [0.0, 0.1, 1.5]])
    tensors = [means, torch.full((4, 3), 0.6), scene.tensors[2], torch.full((4,), 0.5), *scene.tensors[4:]]
    inputs = [tensor.double().requires_grad_() for tensor in tensors]

    def draw(*values: Tensor) -> tuple[Tensor, ...]:
        out = rasterize(*values, scene.pose, scene.intrinsics, 4, 3, backend="gsplat")
        return out.image, out.alpha, out.depth

    assert torch.autograd.gradcheck(draw, inputs[:5] + [inputs[5].detach()], atol=1e-6)


@pytest.mark.parametrize(
    ("installed", "said"),
    [("1.4.0", "too old"), ("1.5.3+pt24cu124", None), ("1.6.0", None), ("1.7.0", "too new"), (None, "not installed")],
)
def test_says_which_gsplat_it_needs(installed: str | None, said: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if installed is None:
            raise metadata.PackageNotFoundError(name)
        return installed

    monkeypatch.setattr(metadata, "version", version)
    missing = cuda.what_is_missing()
    if said is None:
        assert missing is None
    else:
        assert missing is not None and said in missing and "gsplat>=1.5,<1.7" in missing


def test_refuses_tensors_that_are_not_on_a_gpu() -> None:
    scene = random_scene(10, 5, 2, 8, 8)
    with pytest.raises(ValueError, match="CUDA device, these are on cpu"):
        rasterize(*scene.tensors, scene.pose, scene.intrinsics, 8, 8, backend="gsplat")
