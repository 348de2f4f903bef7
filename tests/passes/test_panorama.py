"""An equirectangular view against a room that is known exactly: a box around the camera."""

import numpy as np
import pytest

from engine.passes.baked_view import BakedView, Matte, moved, surface_of
from engine.passes.cryptomatte import RANKS, MatteLayer
from engine.passes.layers import PanopticLayers
from engine.passes.panorama import panorama
from engine.scene import Camera
from tests.tiny_scene import tiny_pose

LOW, HIGH = np.array([-3.0, -2.5, -1.5]), np.array([2.0, 4.0, 2.5])
LAYER = MatteLayer("CryptoInstance", (0,), ("wall",))


def seen_in_box(camera: Camera) -> BakedView:
    """What a camera within the box sees. Each wall has an id, and the colour is the place."""
    grid = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    rays = camera.points(*grid, np.ones((camera.height, camera.width))) - camera.centre
    walls = np.where(rays > 0, HIGH, LOW)
    depth_to = (walls - camera.centre) / np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    depth, axis = depth_to.min(axis=-1), depth_to.argmin(axis=-1)
    wall = (1 + 2 * axis + (np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0)).astype(np.int32)
    place = camera.centre + rays * depth[..., None]
    combined = np.concatenate([place, np.ones_like(place[..., :1])], axis=-1).astype(np.float32)
    share = (wall / 8).astype(np.float32)
    ranks = np.zeros((2 * RANKS, *wall.shape), np.float32)
    ranks[0] = wall
    layers = PanopticLayers(combined, depth.astype(np.float32), wall, 10 * wall, share, share)
    return BakedView(camera, layers, (Matte(LAYER, ranks),))


@pytest.mark.parametrize(("turned", "part"), [(0, 1.0), (1, 0.3)])
def test_every_pixel_of_a_panorama_shows_what_its_ray_hits(turned: int, part: float) -> None:
    pose = tiny_pose(turned, 6)
    pose[:3, 3] = 0.3, -0.2, 0.1
    focal = 360 / (2 * np.pi * part)
    camera = Camera(360, int(180 * part / 0.3 if part < 1 else 180), focal, focal, 180.0, 90.0, pose, "equirectangular")
    exact, found = seen_in_box(camera), panorama(camera, seen_in_box)
    same = found.layers.semantic == exact.layers.semantic
    assert same.mean() > 0.985, "all but pixels at the box's edges"
    assert (found.layers.instance == 10 * found.layers.semantic).all() and (
        found.mattes[0].ranks[0] * 10 == found.layers.instance
    ).all()
    off = np.abs(found.layers.depth - exact.layers.depth)[same]
    assert (off < 1e-3).mean() > 0.97 and off.max() < 0.05, "metres along the ray; off where walls meet"
    assert np.abs(found.layers.combined - exact.layers.combined)[same].max() < 0.05
    inner = same & (
        np.abs(found.surface.position - np.moveaxis(exact.layers.combined[..., :3], -1, 0)).max(axis=0) < 1e-3
    )
    assert inner.mean() > 0.98
    normal = np.zeros((3, *same.shape))
    axis, is_high = np.divmod(exact.layers.semantic - 1, 2)
    np.put_along_axis(normal, axis[None], np.where(is_high, -1.0, 1.0)[None], axis=0)
    cosine = (found.surface.normal * normal).sum(axis=0)
    assert (cosine > 0.999).mean() > 0.9
    aside = camera.at(pose @ np.block([[np.eye(3), np.array([[0.1], [0.0], [0.0]])], [np.zeros((1, 3)), np.eye(1)]]))
    vectors = moved(exact.layers.depth, camera, aside)
    assert 1.0 < np.abs(vectors[:, 60:120]).max() < 30.0, "the shorter way round"
    assert (vectors[0, 80:100, 175:185] < 0).all(), "what is ahead goes left"


def test_a_plane_seen_orthographically_has_its_true_normal() -> None:
    camera = Camera(60, 40, 20.0, 25.0, 31.0, 19.0, tiny_pose(1, 6), "orthographic")
    x, y = (np.arange(60) + 0.5 - 31.0) / 20.0, (np.arange(40)[:, None] + 0.5 - 19.0) / 25.0
    depth = (30.0 + 0.4 * x - 0.2 * y).astype(np.float32)
    surface, points = surface_of(depth, camera), camera.unproject(depth)
    normal = camera.camera_to_world[:3, :3] @ (np.array([0.4, -0.2, -1.0]) / np.sqrt(1.2))
    np.testing.assert_allclose(surface.normal, np.broadcast_to(normal[:, None, None], surface.normal.shape), atol=2e-3)
    np.testing.assert_allclose(np.moveaxis(surface.position, 0, -1), points, atol=1e-5)
    pixels, ahead = camera.project(points)
    np.testing.assert_allclose(ahead, depth, atol=1e-9)
    assert np.abs(pixels[..., 0] - (np.arange(60) + 0.5)).max() < 1e-6
