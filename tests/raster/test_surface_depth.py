"""The depth of the surface: planes at an outline, by hand, and against the float64 reference."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from engine.raster import Rendering
from engine.raster.conventions import NEAR_MEDIAN
from tests.raster.gsplat_in_torch import use_a_stand_in
from tests.raster.reference import rasterize
from tests.raster.scenes import Scene, hard_scenes, steady_pixels

SCENES = hard_scenes()
FRONT, BEHIND = 2.0, 4.0


def draw(scene: Scene, **how: object) -> Rendering:
    return rasterize(
        *scene.tensors, scene.pose, scene.intrinsics, scene.width, scene.height, want_surface=True, **how
    )  # fmt: skip


def seen_straight(means: np.ndarray, scale: float, opacities: object, width: int, height: int) -> Scene:
    """Round Gaussians before a camera at the origin that looks along z."""
    count = len(means)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    opacities = torch.as_tensor(opacities, dtype=torch.float32).expand(count)
    scales, grey = torch.full((count, 3), scale), torch.full((count, 3), 0.5)
    tensors = (torch.from_numpy(means).float(), scales, quats, opacities.contiguous(), grey, torch.ones(count, 1))
    lens = np.array([[40.0, 0, width / 2], [0, 40.0, height / 2], [0, 0, 1]])
    return Scene(tensors, np.eye(4), lens, width, height)


def plane(depth: float, columns: np.ndarray) -> np.ndarray:
    """Centres in a plane across the view, alternately 2 % before and behind it."""
    x, y = (each.ravel() for each in np.meshgrid(columns, np.linspace(-3, 3, 61)))
    z = depth * (1 + 0.02 * np.where(np.arange(len(x)) % 2, 1, -1))
    return np.stack([x, y, z], 1)


def test_surface_depth_at_an_outline_lies_on_one_of_the_two_planes() -> None:
    """A plane ends in the middle of the view, half a metre wide, before a far one."""
    means = np.concatenate([plane(FRONT, np.arange(-1.0, 0, 0.1)), plane(BEHIND, np.linspace(-3, 3, 61))])
    drawn = draw(seen_straight(means, 0.08, 0.6, 60, 40))
    mean, surface = drawn.depth / drawn.alpha, drawn.surface
    assert surface is not None
    rights = [(depth - each).abs() < 0.02 * each for depth in (mean, surface) for each in (FRONT, BEHIND)]
    assert not (rights[0] | rights[1])[:, 25:35].all()  # the mean of all is between the two
    assert (rights[2] | rights[3])[:, 15:50].all()
    assert rights[2][:, 15:28].all() and rights[3][:, 33:50].all()


@pytest.mark.parametrize(
    ("depths", "alphas", "expected"),
    [
        ([2, 4], [0.6, 0.9], 2),
        ([2, 4], [0.4, 0.9], 4),
        ([2, 4], [0.2, 0.2], 2),  # of 0.36 in all, 0.18 is half
        ([2, 4], [0.2, 0.3], 4),
        ([2, 2.08, 4], [0.5, 0.5, 0.9], (0.5 * 2 + 0.25 * 2.08) / 0.75),
        ([2, 2.12, 4], [0.6, 0.5, 0.9], 2),
        ([1.9, 4, 4.1, 4.15, 8], [0.3, 0.4, 0.4, 0.5, 0.9], (0.28 * 4 + 0.168 * 4.1 + 0.126 * 4.15) / 0.574),
    ],
)  # fmt: skip
def test_surface_depth_of_flat_layers_is_exact(depths: list[float], alphas: list[float], expected: float) -> None:
    """Each Gaussian is so wide that its alpha is the same in the whole picture."""
    means = np.array([[0.0, 0.0, depth] for depth in depths])
    scene = seen_straight(means, 50.0, alphas, 5, 3)
    torch.testing.assert_close(draw(scene).surface, torch.full((3, 5), float(expected)), rtol=1e-4, atol=0)


@pytest.mark.parametrize("name", SCENES)
def test_surface_depth_matches_the_reference(name: str) -> None:
    scene = SCENES[name]
    where = (scene.pose, scene.intrinsics, scene.width, scene.height)
    all_of_them = rasterize(*scene.tensors, *where, top_k=len(scene.tensors[0]), backend="reference")
    index, weight = all_of_them.top_indices, all_of_them.top_weights
    ours, steady = draw(scene).surface, steady_pixels(scene)
    assert ours is not None and index is not None and weight is not None
    depths = (scene.tensors[0].double() - torch.from_numpy(scene.pose[:3, 3])) @ torch.from_numpy(scene.pose[:3, 2])
    depth, order = torch.where(weight > 0, depths[index.long()], torch.inf).sort(-1)
    weight, depth = weight.double().gather(-1, order), depth.nan_to_num(posinf=1e9)
    reached = weight.cumsum(-1) >= 0.5 * weight.sum(-1, keepdim=True)
    median = depth.gather(-1, reached.int().argmax(-1, keepdim=True))
    near = weight * ((depth - median).abs() <= NEAR_MEDIAN * median)
    expected = (near * depth).sum(-1) / near.sum(-1).clamp(min=1e-20)
    torch.testing.assert_close(ours[steady].double(), expected[steady], rtol=1e-5, atol=1e-6)


def test_surface_depth_is_equal_for_rows_threads_and_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, threads = SCENES["many labels"], torch.get_num_threads()
    whole = draw(scene).surface
    assert whole is not None
    rows = draw(scene, rows=(16, 32)).surface
    torch.testing.assert_close(rows, whole[16:32], rtol=1e-5, atol=1e-6)
    torch.set_num_threads(1)
    try:
        assert torch.equal(draw(scene).surface, whole)
    finally:
        torch.set_num_threads(threads)
    use_a_stand_in(monkeypatch)
    assert torch.equal(draw(scene, backend="gsplat").surface, whole)
    nothing = replace(scene, tensors=tuple(tensor[:0] for tensor in scene.tensors))
    for backend in ("numba", "gsplat"):
        drawn = draw(nothing, backend=backend).surface
        assert drawn is not None and not drawn.any()
