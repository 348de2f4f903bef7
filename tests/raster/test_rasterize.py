"""The back end numba against the float64 reference, and properties of any scene."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.raster import Rendering
from engine.raster.interface import _pinhole
from tests.raster.reference import project, rasterize
from tests.raster.room_workload import room_workload
from tests.raster.scenes import (
    GROUPS,
    LAYERS,
    Scene,
    assert_labels_affect_nothing_else,
    assert_same_bits_with_any_threads,
    hard_scenes,
    missed_elements,
    random_scene,
    render,
    scenes_by_channels,
    steady_pixels,
)

SCENES = hard_scenes() | scenes_by_channels()
MOST_NEAR_A_THRESHOLD = 0.03
"""Share of a scene's pixels near a threshold, at most. Float32 may decide these otherwise, so they are left out."""
MAY_MISS = {"long lists": 3} | dict.fromkeys(scenes_by_channels(), 1)
"""Elements of a group that may miss the bound on gradients, besides 1e-4 of them (which is none in a small group).
Float32 is good to about 1e-6 of a Gaussian's gradient, and an element that happens to be a thousandth of its neighbours
misses its own thousandth; through a list of a thousand the transmittance, rounded at each, drifts by 2e-6. Over all
scenes together 1e-4 may miss."""


@pytest.mark.parametrize("name", SCENES)
def test_the_rasterizer_matches_the_reference(name: str, record_property: Callable[[str, object], None]) -> None:
    scene = SCENES[name]
    steady = steady_pixels(scene)
    near = int((~steady).sum())
    record_property("pixels near a threshold", near)
    print(f"{name}: {near} of {steady.numel()} pixels are near a threshold")  # pytest -rP shows it
    assert near <= MOST_NEAR_A_THRESHOLD * steady.numel(), f"{near} of {steady.numel()} pixels are near a threshold"
    ours, our_gradients = render(scene, "numba", steady)
    theirs, their_gradients = render(scene, "reference", steady)
    assert torch.equal(ours.visible, theirs.visible)
    torch.testing.assert_close(ours.means2d, theirs.means2d.float(), rtol=1e-6, atol=1e-4)
    for layer in LAYERS:
        got, expected = getattr(ours, layer)[steady], getattr(theirs, layer)[steady]
        torch.testing.assert_close(got, expected, rtol=0, atol=1e-5, msg=lambda text, layer=layer: f"{layer}: {text}")
    for group in GROUPS:
        missed = missed_elements(our_gradients[group], their_gradients[group])
        count = their_gradients[group].numel()
        assert missed <= max(1e-4 * count, MAY_MISS.get(name, 0)), f"{group}: {missed} of {count} elements"


def test_rasterizer_gradients_match_the_reference_in_all_scenes() -> None:
    missed, counts = dict.fromkeys(GROUPS, 0), dict.fromkeys(GROUPS, 0)
    for scene in SCENES.values():
        steady = steady_pixels(scene)
        ours, theirs = (render(scene, backend, steady)[1] for backend in ("numba", "reference"))
        for group in GROUPS:
            missed[group] += missed_elements(ours[group], theirs[group])
            counts[group] += theirs[group].numel()
    for group in GROUPS:
        assert missed[group] <= 1e-4 * counts[group], f"{group}: {missed[group]} of {counts[group]} elements"


@pytest.mark.parametrize("backend", ["numba", "reference"])
@pytest.mark.parametrize("count", [0, 3])
def test_views_without_gaussians_are_drawn_empty(backend: str, count: int) -> None:
    scene = random_scene(0, count, 4, 20, 20)
    means = scene.tensors[0].clone()
    means[:, 2] = -5.0
    out, gradients = render(scene.changed(0, means), backend)
    assert not out.visible.any()
    for layer in LAYERS:
        assert not getattr(out, layer).any()
    assert not any(gradient.any() for gradient in gradients.values())


@pytest.mark.parametrize("channels", [1, 5, 20])
def test_rasterizing_gives_the_same_bits_with_any_number_of_threads(channels: int) -> None:
    scene = random_scene(5, 1100, channels, 70, 50)
    assert_same_bits_with_any_threads(scene, "numba")


def test_rasterizing_a_room_gives_the_same_bits_with_any_threads() -> None:
    """More Gaussians and tiles than the small scenes, so that the workers really do share everything."""
    work = room_workload(25_000, 320, 240)
    arrays = (work.means, work.scales, work.quats, work.opacities, work.colours, work.labels)
    tensors = tuple(torch.from_numpy(array) for array in arrays)
    scene = Scene(tensors, work.camera_to_world, work.intrinsics, work.width, work.height)
    assert_same_bits_with_any_threads(scene, "numba")


@pytest.mark.parametrize("backend", ["numba", "reference"])
def test_drawing_labels_changes_no_other_output(backend: str) -> None:
    assert_labels_affect_nothing_else(backend)


@pytest.mark.parametrize("layer", LAYERS)
def test_a_loss_on_one_layer_has_no_gradient_from_the_others(layer: str) -> None:
    """The other layers have no gradient then, not even one left over from the pass before."""
    scene = random_scene(9, 100, 4, 30, 20)
    render(scene, "numba")
    steady = steady_pixels(scene)
    got, expected = (render(scene, backend, steady, (layer,))[1] for backend in ("numba", "reference"))
    for group, gradient in got.items():
        wanted = torch.zeros_like(gradient) if expected[group] is None else expected[group]
        assert missed_elements(gradient, wanted) <= 1e-4 * gradient.numel(), group


def test_label_gradients_do_not_depend_on_other_label_channels() -> None:
    """Tiles copy and add up only the channels with a gradient in them: none, few or all."""
    scene, channels = random_scene(11, 900, 37, 70, 50), torch.arange(37)
    by = torch.randn(50, 70, 37, generator=torch.Generator().manual_seed(0))
    tile = (torch.arange(50) // 16)[:, None] * 5 + torch.arange(70) // 16
    some = ((channels + tile[..., None]) % 7 == 0) & (tile[..., None] > 2) & steady_pixels(scene)[..., None]
    few = torch.where(some, by, 0.0)  # a product would leave -0.0, which counts as a gradient

    def gradient(by: torch.Tensor, backend: str = "numba") -> torch.Tensor:
        labels = scene.tensors[5].clone().requires_grad_()
        drawn = rasterize(*scene.tensors[:5], labels, scene.pose, scene.intrinsics, 70, 50, backend=backend).labels
        drawn.backward(by.to(drawn.dtype))
        return labels.grad

    alone = gradient(few)
    for parity in (0, 1):
        own = channels % 2 == parity
        assert torch.equal(gradient(torch.where(own, few, by))[:, own], alone[:, own])
    assert alone.any() and missed_elements(alone, gradient(few, "reference")) <= 1e-4 * alone.numel()


def test_the_rasterizer_works_without_labels() -> None:
    scene = random_scene(7, 100, 4, 30, 20)
    bare = rasterize(*scene.tensors[:5], None, scene.pose, scene.intrinsics, 30, 20)
    full = rasterize(*scene.tensors, scene.pose, scene.intrinsics, 30, 20)
    assert bare.labels is None
    assert torch.equal(bare.image, full.image)


@pytest.mark.parametrize("top_k", [1, 3, 500])
def test_the_gaussians_that_contribute_most_match_the_reference(top_k: int) -> None:
    scene = random_scene(8, 200, 2, 35, 21)
    steady = steady_pixels(scene)
    outs = [
        rasterize(*scene.tensors, scene.pose, scene.intrinsics, 35, 21, top_k=top_k, backend=backend)
        for backend in ("numba", "reference")
    ]
    ours, theirs = ((out.top_indices[steady], out.top_weights[steady]) for out in outs)
    torch.testing.assert_close(ours[1], theirs[1], rtol=0, atol=1e-5)
    assert (ours[0] != theirs[0]).float().mean() < 1e-3  # equal weights may swap
    if top_k == 500:
        torch.testing.assert_close(outs[0].top_weights.sum(-1), outs[0].alpha, rtol=0, atol=1e-5)


def test_the_references_gradients_match_finite_differences() -> None:
    scene = random_scene(9, 4, 2, 4, 3)
    means = torch.tensor([[0.1, 0.0, 2.0], [-0.3, 0.1, 2.5], [0.2, -0.2, 3.0], [0.0, 0.1, 1.5]])
    tensors = [means, torch.full((4, 3), 0.6), scene.tensors[2], torch.full((4,), 0.5), *scene.tensors[4:]]
    inputs = [tensor.double().requires_grad_() for tensor in tensors]

    def draw(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        out = rasterize(*values, scene.pose, scene.intrinsics, 4, 3, backend="reference")
        return out.image, out.alpha, out.depth

    assert torch.autograd.gradcheck(draw, inputs[:5] + [inputs[5].detach()], atol=1e-6)


def test_the_rasterizer_refuses_bad_arguments() -> None:
    scene = random_scene(10, 5, 2, 8, 8)
    where = (scene.pose, scene.intrinsics, 8, 8)
    with pytest.raises(ValueError, match="scales has shape"):
        rasterize(scene.tensors[0], scene.tensors[0][:3], *scene.tensors[2:], *where)
    with pytest.raises(ValueError, match="float32"):
        rasterize(*(tensor.double() for tensor in scene.tensors), *where)
    with pytest.raises(ValueError, match="unknown back end"):
        rasterize(*scene.tensors, *where, backend="magic")
    with pytest.raises(ValueError, match="gsplat"):
        rasterize(*scene.tensors, *where, backend="gsplat")
    with pytest.raises(ValueError, match="at least 1"):
        rasterize(*scene.tensors, scene.pose, scene.intrinsics, 0, 8)


def test_drawing_some_rows_matches_the_whole_picture() -> None:
    room = room_workload(2000, 96, 72)
    inputs = [torch.from_numpy(each) for each in (room.means, room.scales, room.quats, room.opacities, room.colours)]
    labels, camera = torch.from_numpy(room.labels), (room.camera_to_world, room.intrinsics, room.width, room.height)
    whole = rasterize(*inputs, labels, *camera)
    for first, end in ((0, 16), (7, 33), (33, 72)):
        some = rasterize(*inputs, labels, *camera, rows=(first, end))
        for layer in LAYERS:
            expected = getattr(whole, layer)[first:end]
            torch.testing.assert_close(getattr(some, layer), expected, atol=2e-4, rtol=1e-3)
    with pytest.raises(ValueError, match="outside an image"):
        rasterize(*inputs, labels, *camera, rows=(3, 73))


scenes = st.builds(
    random_scene,
    seed=st.integers(0, 10_000),
    count=st.integers(0, 60),
    channels=st.just(3),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
)


def draw(scene: Scene) -> Rendering:
    return rasterize(*scene.tensors, scene.pose, scene.intrinsics, scene.width, scene.height)


@settings(max_examples=25, deadline=None)
@given(scenes)
def test_blending_weights_of_a_pixel_sum_to_its_alpha(scene: Scene) -> None:
    ones = scene.changed(4, torch.ones_like(scene.tensors[4]))
    out = draw(ones)
    assert (out.alpha >= 0.0).all() and (out.alpha <= 1.0).all()
    torch.testing.assert_close(out.image, out.alpha[:, :, None].expand_as(out.image), rtol=0, atol=1e-5)


@settings(max_examples=25, deadline=None)
@given(scenes)
def test_labels_are_blended_as_colours(scene: Scene) -> None:
    out = draw(scene.changed(5, scene.tensors[4]))
    torch.testing.assert_close(out.labels, out.image, rtol=0, atol=1e-5)


@settings(max_examples=25, deadline=None)
@given(scenes, st.randoms(use_true_random=False))
def test_the_order_of_gaussians_does_not_change_the_picture(scene: Scene, random: object) -> None:
    count = scene.tensors[0].shape[0]
    order = torch.from_numpy(np.random.default_rng(0).permutation(count))
    shuffled = replace(scene, tensors=tuple(tensor[order] for tensor in scene.tensors))
    assert torch.equal(draw(scene).image, draw(shuffled).image)


@settings(max_examples=25, deadline=None)
@given(scenes, st.floats(0.1, 10.0))
def test_the_length_of_quaternions_does_not_change_the_picture(scene: Scene, factor: float) -> None:
    longer = draw(scene.changed(2, scene.tensors[2] * factor))
    assert (longer.image - draw(scene).image).abs().mean() < 1e-5


def test_an_orthographic_picture_matches_a_very_long_lens() -> None:
    scene, away = random_scene(0, 250, 5, 37, 29), 1e7
    scene.intrinsics[:] = [[8.0, 0.0, 16.0], [0.0, 9.0, 17.0], [0.0, 0.0, 1.0]]
    ours = render_parallel(scene, "numba", scene.tensors)
    theirs = render_parallel(scene, "reference", [each.double() for each in scene.tensors])
    assert torch.equal(ours.visible, theirs.visible) and ours.visible.sum() > 100
    for layer in LAYERS:
        torch.testing.assert_close(getattr(ours, layer), getattr(theirs, layer).float(), rtol=0, atol=1e-5)
    pose, lens = scene.pose.copy(), np.diag([away, away, 1.0]) @ scene.intrinsics
    pose[:3, 3] -= away * pose[:3, 2]
    lens[:2, 2] = scene.intrinsics[:2, 2]
    geometry = [each.double() for each in scene.tensors[:3]]
    near, far = (
        _pinhole(*camera, 37, 29, near=0.01, is_orthographic=is_near)
        for camera, is_near in (((scene.pose, scene.intrinsics), True), ((pose, lens), False))
    )
    for one, other, most in zip(project(*geometry, near), project(*geometry, far), (1e-4, 1e-2, 1e-6), strict=True):
        seen = project(*geometry, near)[2] > 0.01
        shift = away if one.ndim == 1 else 0.0
        assert (one - other + shift)[seen].abs().max() < most
    drawn = ours.alpha > 0.5
    assert ours.surface is not None and (ours.surface[drawn] > 0).all()
    with pytest.raises(ValueError, match="no gradients"):
        render_parallel(scene, "numba", [each.clone().requires_grad_() for each in scene.tensors])


def render_parallel(scene: Scene, backend: str, tensors: Sequence[torch.Tensor]) -> Rendering:
    at = scene.pose, scene.intrinsics, scene.width, scene.height
    return rasterize(*tensors, *at, is_orthographic=True, want_surface=backend == "numba", backend=backend)
