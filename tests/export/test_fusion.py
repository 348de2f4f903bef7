"""Surfaces fused of made-up depth: where they lie, how they are turned, and that they are whole."""

from dataclasses import replace

import numpy as np
import pytest

from engine.export import fusion
from engine.export.fusion import GRAZED, STRAIGHT, VOXEL, Grain, SmallView, fuse
from engine.export.mending import close_holes
from engine.export.points import point_normals
from engine.scene import Camera

RADIUS = 0.3
COLOUR = (200, 100, 50)


def view_of_ball(number: int) -> SmallView:
    """A ball in the origin, seen from one of the six sides at 1.2 m."""
    axis, sign = number // 2, 1 - 2 * (number % 2)
    pose = np.eye(4)
    forward = -sign * np.eye(3)[axis]
    right = np.eye(3)[(axis + 1) % 3]
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    pose[:3, 3] = -1.2 * forward
    camera = Camera(160, 160, 180.0, 180.0, 80.0, 80.0, pose)
    column, row = np.meshgrid(np.arange(160) + 0.5, np.arange(160) + 0.5)
    ray = np.stack([(column - 80) / 180, (row - 80) / 180, np.ones_like(column)], axis=-1)
    a, b, c = (ray**2).sum(-1), -2 * 1.2 * ray[..., 2], 1.2**2 - RADIUS**2
    root = b**2 - 4 * a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / (2 * a), 0).astype(np.float32)
    rgb = np.broadcast_to(np.array(COLOUR, np.uint8), (160, 160, 3))
    return SmallView(camera, depth, rgb, np.zeros((160, 160), np.int64))


def test_a_fused_ball_is_round_and_closed_with_outward_normals() -> None:
    surface = fuse([view_of_ball(number) for number in range(6)] * 2)
    radius = np.linalg.norm(surface.xyz, axis=1)
    assert abs(np.median(radius) - RADIUS) < 0.1 * VOXEL and abs(radius - RADIUS).max() < 0.6 * VOXEL
    outwards = surface.xyz / radius[:, None]
    assert np.median((surface.normal * outwards).sum(axis=1)) > 0.99
    a, b, c = surface.xyz[surface.triangles].transpose(1, 0, 2).astype(np.float64)
    turned = (np.cross(b - a, c - a) * a).sum(axis=1)
    assert (turned >= 0).mean() > 0.99
    volume = turned.sum() / 6
    assert abs(volume / (4 / 3 * np.pi * RADIUS**3) - 1) < 0.03
    surface, _ = close_holes(surface, np.zeros(len(surface.xyz), np.int64))  # as an export does
    edges = np.sort(surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count % 2 == 0).all(), "a hole"
    assert (surface.rgb == COLOUR).all()


@pytest.mark.parametrize("most", [1, 20, 60])
def test_fusing_in_slabs_gives_the_same_surface_as_fusing_at_once(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    views = [view_of_ball(number) for number in range(6)] * 2
    whole = fuse(views)
    monkeypatch.setattr(fusion, "MOST_BLOCKS", most)
    told: list[float] = []
    parts = fuse(views, progress=lambda done, total: told.append(done / total))
    for name in ("xyz", "rgb", "normal", "triangles"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
    assert told == sorted(told) and len(told) > 3 * len(views)


def test_fusing_the_same_views_twice_gives_the_same_bytes() -> None:
    one, other = (fuse([view_of_ball(number) for number in range(6)] * 2) for _ in range(2))
    assert (one.xyz.tobytes(), one.triangles.tobytes()) == (other.xyz.tobytes(), other.triangles.tobytes())
    assert len(np.unique(one.xyz, axis=0)) == len(one.xyz)


@pytest.mark.parametrize("reaches", [STRAIGHT, GRAZED])
def test_views_without_depth_do_not_change_a_fused_surface(reaches: tuple[tuple[float, float], ...]) -> None:
    views = [view_of_ball(0)] * 2
    empty = replace(views[0], depth=np.zeros_like(views[0].depth))
    grain = Grain(reaches=reaches)
    np.testing.assert_array_equal(fuse([empty, *views, empty], grain).xyz, fuse(views, grain).xyz)
    assert not len(fuse([empty], grain).triangles)


def test_normals_of_points_on_a_plane_are_the_planes() -> None:
    random = np.random.default_rng(0)
    xyz = np.c_[random.uniform(-1, 1, (500, 2)), random.normal(0, 1e-4, 500)].astype(np.float32)
    normals = point_normals(xyz, np.array([[0.0, 0.0, 2.0]]))
    assert normals.dtype == np.float32 and (normals[:, 2] > 0.999).all()
    assert point_normals(xyz[:0], np.zeros((1, 3))).shape == (0, 3)
