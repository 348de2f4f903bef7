"""Memory is reused, never while somebody uses it, and stays within its bound."""

import sys
import tracemalloc

import numpy as np
import pytest
import torch

from engine.machine import memory
from engine.raster import rasterize
from engine.raster.blending.backward import backward_scratch_size
from engine.raster.conventions import MEMBERS
from tests.machine.test_memory import held_bytes
from tests.raster.room_workload import Workload, room_workload
from tests.raster.scenes import LAYERS, random_scene, render


def test_a_rendered_picture_is_not_overwritten_by_later_ones() -> None:
    scene = random_scene(0, 100, 4, 40, 30)
    first = rasterize(*scene.tensors, scene.pose, scene.intrinsics, 40, 30)
    copy = first.image.clone()
    darker = scene.changed(4, scene.tensors[4] * 0.1)
    for _ in range(3):
        rasterize(*darker.tensors, scene.pose, scene.intrinsics, 40, 30)
    assert torch.equal(first.image, copy)


def test_a_late_or_repeated_backward_pass_gives_the_same_gradients() -> None:
    """What the first picture keeps for its backward pass is overwritten neither by other pictures nor by that pass
    itself."""
    scene, other = random_scene(3, 200, 6, 50, 40), random_scene(4, 200, 6, 50, 40)
    gradients = []
    for pictures_between in (0, 3):
        tensors = [tensor.clone().requires_grad_() for tensor in scene.tensors]
        out = rasterize(*tensors, scene.pose, scene.intrinsics, 50, 40)
        for _ in range(pictures_between):
            render(other, "numba")
        assert out.labels is not None
        layers = [out.image, out.labels, out.alpha, out.depth]
        upstream = [torch.linspace(-1.0, 2.0, layer.numel()).reshape(layer.shape) for layer in layers]
        gradients += [torch.autograd.grad(layers, tensors, upstream, retain_graph=True) for _ in range(2)]
    for again in gradients[1:]:
        assert all(map(torch.equal, again, gradients[0]))
    assert all(gradient.any() for gradient in gradients[0])


def step(work: Workload, change: int = 0) -> None:
    """Forward and backward; ``change`` moves and shrinks the Gaussians a little."""
    arrays = (work.means, work.scales, work.quats, work.opacities, work.colours, work.labels)
    tensors = [torch.from_numpy(array).clone() for array in arrays]
    tensors[0] += 0.002 * change * torch.randn(tensors[0].shape, generator=torch.Generator().manual_seed(change))
    tensors[1] *= 1.0 - 0.003 * change
    for tensor in tensors:
        tensor.requires_grad_()
    out = rasterize(*tensors, work.camera_to_world, work.intrinsics, work.width, work.height)
    assert out.labels is not None
    torch.autograd.backward([out.image, out.labels], [out.image.detach(), out.labels.detach()])


@pytest.mark.parametrize("count", [10_000, 50_000])
def test_the_rasterizers_memory_stays_within_its_bound(count: int) -> None:
    work = room_workload(count)
    memory._blocks.clear()
    step(work)
    assert held_bytes() <= 2500 * count + 450 * work.width * work.height


@pytest.mark.parametrize("count", [10_000, 50_000])
def test_rasterizing_a_slowly_changing_scene_allocates_no_memory(count: int) -> None:
    work = room_workload(count)
    memory._blocks.clear()
    for _ in range(2):
        step(work)
    held = held_bytes()
    tracemalloc.start()
    try:
        for change in range(1, 6):
            step(work, change)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    little = 1_000_000  # of the 100 MB that a step works with
    assert abs(held_bytes() - held) <= little
    assert peak <= little


def test_one_crowded_tile_keeps_the_memory_bounded() -> None:
    """Everything is seen from afar, with more threads than there is work for."""
    work, count = room_workload(4000), 4000
    memory._blocks.clear()
    arrays = (work.means * 1e-3, work.scales, work.quats, work.opacities, work.colours, work.labels)
    tensors = [torch.from_numpy(np.ascontiguousarray(array, np.float32)).requires_grad_() for array in arrays]
    tensors[1] = tensors[1].detach().mul_(1e-3).requires_grad_()
    pose = np.eye(4)
    pose[2, 3] = -5.0
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(16)
        out = rasterize(*tensors, pose, np.array([[100.0, 0, 24], [0, 100, 24], [0, 0, 1]]), 48, 48)
        assert out.labels is not None and out.visible.all()
        torch.autograd.backward([out.image, out.labels], [out.image.detach(), out.labels.detach()])
    finally:
        torch.set_num_threads(threads)
    scratch = 16 * 4 * (backward_scratch_size(work.labels.shape[1]) + MEMBERS)  # each worker's on the way back
    assert held_bytes() <= 2500 * count + 450 * 48 * 48 + scratch


def test_the_rasterizer_never_reads_stale_memory() -> None:
    """Filling free memory with NaN changes no bit."""
    for count in (1, 3, 17, 50, 130, 700):
        scene = random_scene(count, count, 5, 33, 18)
        clean, clean_gradients = render(scene, "numba")
        kept = [getattr(clean, layer).clone() for layer in LAYERS], {k: v.clone() for k, v in clean_gradients.items()}
        del clean, clean_gradients
        for block in memory._blocks:
            if sys.getrefcount(block.bytes) == memory._REFERENCES:
                block.bytes[:] = 255
        out, gradients = render(scene, "numba")
        for layer, expected in zip(LAYERS, kept[0], strict=True):
            assert torch.equal(getattr(out, layer), expected), layer
        for group, gradient in gradients.items():
            assert torch.equal(gradient, kept[1][group]), group
