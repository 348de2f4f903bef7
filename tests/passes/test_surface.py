"""Positions and normals of planes that are known exactly."""

import numpy as np
import pytest

from engine.passes.baked_view import moved, surface_of
from engine.scene import Camera
from tests.tiny_scene import tiny_intrinsics, tiny_pose, trace_view

SIZE = (160, 120)


def camera(index: int) -> Camera:
    lens = tiny_intrinsics(SIZE)
    return Camera(*SIZE, lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2], tiny_pose(index, 6))


@pytest.mark.parametrize("index", [0, 2, 5])
def test_depth_and_normals_of_a_room_of_boxes_are_accurate(index: int) -> None:
    view, seen = trace_view(tiny_pose(index, 6), tiny_intrinsics(SIZE), SIZE), camera(index)
    surface = surface_of(view.depth, seen)
    np.testing.assert_allclose(np.moveaxis(surface.position, 0, -1), seen.unproject(view.depth), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(surface.normal, axis=0), 1.0, atol=1e-5)
    # every face is perpendicular to an axis: so is its normal, but where two faces meet
    assert np.median(np.abs(surface.normal).max(axis=0)) > 0.9999
    assert (np.abs(surface.normal).max(axis=0) > 0.99).mean() > 0.8
    to_camera = seen.centre[:, None, None] - surface.position
    assert ((surface.normal * to_camera).sum(axis=0) > 0).mean() > 0.999
    floor = (view.semantic == 2) & (surface.position[2] < 1e-4)
    assert np.median(surface.normal[2][floor]) == pytest.approx(1.0, abs=1e-4)


def test_pixels_without_depth_have_no_position_or_normal() -> None:
    depth = np.full((120, 160), 2.0, np.float32)
    depth[40:60, 50:90] = 0.0
    surface = surface_of(depth, camera(0))
    assert not surface.position[:, depth == 0].any() and not surface.normal[:, depth == 0].any()
    assert np.isfinite(surface.position).all() and np.isfinite(surface.normal).all()


def test_the_normal_of_a_lone_pixel_faces_the_camera() -> None:
    depth = np.zeros((120, 160), np.float32)
    depth[10, 20] = 1.5
    normal = surface_of(depth, camera(0)).normal[:, 10, 20]
    np.testing.assert_allclose(normal, -camera(0).camera_to_world[:3, 2], atol=1e-6)


def test_motion_vectors_lead_to_the_points_place_in_the_other_picture() -> None:
    seen, (fx, _, cx), (_, fy, cy) = camera(0), *tiny_intrinsics(SIZE)[:2]
    depth = trace_view(tiny_pose(0, 6), tiny_intrinsics(SIZE), SIZE).depth.copy()
    depth[:10] = 0.0
    other = Camera(*SIZE, 1.2 * fx, 1.1 * fy, cx + 3, cy - 2, tiny_pose(1, 6))
    pixel, _ = other.project(seen.unproject(depth))
    right, up = moved(depth, seen, other)
    row, column = np.indices(depth.shape) + 0.5
    shown = depth > 0
    assert not right[~shown].any() and not up[~shown].any() and np.abs(right).max() > 10
    np.testing.assert_allclose((column + right)[shown], pixel[shown][:, 0], atol=1e-9)
    np.testing.assert_allclose((row - up)[shown], pixel[shown][:, 1], atol=1e-9)
    np.testing.assert_allclose(moved(depth, seen, seen), 0, atol=1e-10)
    assert not moved(depth, seen, seen.at(seen.camera_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0]))).any(), "behind it"
