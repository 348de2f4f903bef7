"""Views in bands of rows, clipped, and with smaller pixels than the training pictures have."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from engine.model.detail import finest_pixels
from engine.model.neural_gaussians import ClipRange
from engine.model.render import render_bands, render_view, row_bands
from engine.model.structured import SceneFill
from engine.scene import Camera
from tests.model.some_scene import CAMERA as SMALL
from tests.model.some_scene import some_scene

CAMERA = Camera(70, 90, 70.0, 75.0, 33.0, 47.0, np.eye(4))
LAYERS = ("image", "alpha", "depth", "class_coverage", "instance_coverage")


def test_a_view_rendered_in_bands_equals_the_whole_view() -> None:
    scene = some_scene((4, 9, 0, 0, 0))
    whole, bands = render_view(scene, CAMERA), list(render_bands(scene, CAMERA, most_bytes=1))
    assert [len(band.alpha) for band in bands] == [16, 16, 16, 16, 16, 10]
    assert whole.alpha.max() > 0.3
    for layer in LAYERS:
        stacked = np.concatenate([getattr(band, layer) for band in bands])
        np.testing.assert_allclose(stacked, getattr(whole, layer), atol=2e-4, err_msg=layer)
    points = [band.camera.unproject(band.depth) for band in bands]
    np.testing.assert_allclose(np.concatenate(points), CAMERA.unproject(whole.depth), atol=1e-3)


def test_bands_of_a_view_stay_within_the_memory_limit() -> None:
    camera = Camera(1296, 968, 900.0, 900.0, 648.0, 484.0, np.eye(4))
    bands = row_bands(camera, 500, 1 << 27)
    assert bands[0][0] == 0 and bands[-1][1] == 968
    assert all(end == first for (_, end), (first, _) in zip(bands, bands[1:], strict=False))
    assert max(end - first for first, end in bands) * 1296 * 500 * 4 <= 1.3 * (1 << 27)
    assert row_bands(camera, 500, None) == [(0, 968)]


def test_surface_outside_the_clipping_range_is_not_drawn() -> None:
    scene = some_scene((4, 9, 0, 0, 0))
    (near,) = render_bands(scene, CAMERA, clip=ClipRange(far=2.0))
    (far,) = render_bands(scene, CAMERA, clip=ClipRange(near=2.0))
    assert near.depth.max() < 2.0 and (far.depth[far.alpha > 1e-3] > 2.0 - 1e-5).all()
    (nothing,) = render_bands(scene, CAMERA, clip=ClipRange(near=90.0))
    assert not nothing.alpha.any() and not nothing.depth.any()


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_filled_floor_seen_at_a_slant_is_drawn_at_its_place(projection: str) -> None:
    """Its disks are smaller than a pixel, and many are in a line of sight's way."""
    scene, camera = some_scene((4, 9, 0, 0, 0)), Camera(64, 48, 60.0, 60.0, 32.0, 0.0, np.eye(4))
    if projection == "orthographic":
        turn = np.eye(4)
        turn[1:3, 1:3] = [[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]]
        camera = Camera(64, 48, 20.0, 20.0, 32.0, 24.0, turn, projection=projection)
    x, z = np.meshgrid(np.arange(-2, 2, 0.02), np.arange(1.5, 9, 0.02))
    means = torch.from_numpy(np.stack([x, np.full_like(x, 1.5), z], -1).reshape(-1, 3)).float()
    one, upright = torch.ones(len(means)), torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0])
    gone = torch.ones(len(scene.anchors) * scene.anchors.gaussians_per_anchor, dtype=torch.bool)
    scales, quats = torch.tensor([0.016, 0.016, 0.002]), upright.repeat(len(means), 1)
    fill = SceneFill(gone, means, scales.repeat(len(means), 1), quats, 0.98 * one, one[:, None].repeat(1, 3), one)
    shown = render_view(replace(scene, fill=fill), camera)
    place = camera.unproject(shown.depth)[shown.alpha > 0.9]
    place = place[(place[:, 2] > 3) & (place[:, 2] < 8)]
    above = (1.5 - place[:, 1]) * (60.0 / place[:, 2] if projection == "perspective" else 20.0)  # in pixels, about
    assert len(place) > 200 and np.median(above) < 0.7


def test_the_finest_pixel_size_that_shows_a_point_is_found() -> None:
    pose = np.eye(4)
    pose[2, 3] = 1.0
    near, narrow = SMALL.at(pose), Camera(10, 10, 80.0, 80.0, 5.0, 5.0, np.eye(4))
    places = np.array([[0.0, 0, 2], [0.9, 0, 2], [0.9, 0, 3], [0, 0, 0.5], [0, 0, -1]])
    found = finest_pixels(places, [SMALL, near, narrow])
    by_near, by_narrow = 1 / 40, 0.5 / 80
    np.testing.assert_allclose(found, [by_near, 2 / 40, 2 * by_near, by_narrow, 0.0], rtol=1e-6)
    assert not finest_pixels(places, []).any()


def test_rendering_at_training_size_ignores_the_finest_pixel_size() -> None:
    scene = some_scene((4, 9, 0, 0, 0))
    finest = torch.from_numpy(finest_pixels(scene.anchors.position.numpy(), [SMALL]))
    for camera in (SMALL, SMALL.resized(20, 15)):
        before, after = render_view(scene, camera), render_view(replace(scene, finest=finest), camera)
        np.testing.assert_array_equal(after.image, before.image)


def test_enlarged_renders_have_no_more_cracks_than_training_ones() -> None:
    scene = some_scene((4, 9, 0, 0, 0))
    scene.anchors.log_scale[:, 3:] -= 2.5  # thinner than a pixel
    finest = torch.from_numpy(finest_pixels(scene.anchors.position.numpy(), [SMALL]))
    trained, large = render_view(scene, SMALL), SMALL.resized(160, 120)
    cracked, whole = (render_view(each, large).alpha for each in (scene, replace(scene, finest=finest)))
    assert cracked.mean() < 0.3 * trained.alpha.mean()
    assert whole.mean() == pytest.approx(trained.alpha.mean(), rel=0.05)
