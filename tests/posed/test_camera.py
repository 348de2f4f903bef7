from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from engine.scene import Camera
from tests.tiny_scene import tiny_intrinsics, tiny_pose, trace_view

lengths = st.floats(20.0, 400.0)
sizes = st.tuples(st.integers(4, 40), st.integers(4, 40))


def camera(size: tuple[int, int], fx: float = 50.0, fy: float = 60.0, pose: np.ndarray | None = None) -> Camera:
    width, height = size
    return Camera(width, height, fx, fy, width * 0.6, height * 0.4, tiny_pose(1, 6) if pose is None else pose)


@given(sizes, lengths, lengths, st.floats(0.05, 60.0), st.integers(0, 5))
def test_projecting_what_was_unprojected_gives_the_pixel_centres(
    size: tuple[int, int], fx: float, fy: float, metres: float, index: int
) -> None:
    one = camera(size, fx, fy, tiny_pose(index, 6))
    pixels, depth = one.project(one.unproject(np.full(size[::-1], metres, np.float32)))
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    np.testing.assert_allclose(pixels, np.stack([x, y], axis=-1), atol=1e-6)
    np.testing.assert_allclose(depth, np.float32(metres), rtol=1e-9)


@given(sizes, sizes, st.floats(0.1, 20.0))
def test_a_resized_camera_sees_a_point_at_the_same_share_of_the_picture(
    size: tuple[int, int], other: tuple[int, int], metres: float
) -> None:
    one = camera(size)
    point = one.centre + one.camera_to_world[:3, :3] @ np.array([0.1, -0.2, metres])
    pixels, depth = one.project(point)
    resized, same_depth = one.resized(*other).project(point)
    np.testing.assert_allclose(resized / np.array(other), pixels / np.array(size), atol=1e-9)
    assert depth == same_depth


def test_the_world_to_camera_matrix_is_the_inverse() -> None:
    one = camera((64, 48))
    np.testing.assert_allclose(one.world_to_camera @ one.camera_to_world, np.eye(4), atol=1e-12)


def test_a_point_behind_the_camera_has_negative_depth_and_finite_pixels() -> None:
    one = camera((64, 48))
    pixels, depth = one.project(one.centre - one.camera_to_world[:3, 2])
    assert depth < 0.0 and np.isfinite(pixels).all()


def test_traced_depth_lifts_onto_the_surfaces_of_the_room() -> None:
    size = (64, 48)
    K, pose = tiny_intrinsics(size), tiny_pose(2, 6)
    view = trace_view(pose, K, size)
    points = Camera(*size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], pose).unproject(view.depth)
    np.testing.assert_allclose(points[view.semantic == 2][:, 2], 0.0, atol=1e-5)
    walls = points[view.semantic == 1]
    on_a_wall = np.minimum.reduce([np.abs(walls[:, 0] - x) for x in (0, 4)] + [np.abs(walls[:, 1] - y) for y in (0, 3)])
    np.testing.assert_allclose(on_a_wall, 0.0, atol=1e-5)
