"""Facing, spacing and the overview of points on surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from plgs.plgs_blender.cameras import overview_camera
from plgs.plgs_blender.clouds import SurfaceGrid


def room(step: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Points of the six faces of a 4 x 3 x 2.5 room, away from its edges, and their inward normals."""
    size = np.array([4.0, 3.0, 2.5])
    xyz, normals = [], []
    for axis in range(3):
        others = [each for each in range(3) if each != axis]
        grids = np.meshgrid(*(np.arange(0.3, size[each] - 0.3, step) for each in others))
        for side in (0.0, 1.0):
            face = np.zeros((grids[0].size, 3))
            face[:, axis] = side * size[axis]
            face[:, others[0]], face[:, others[1]] = grids[0].ravel(), grids[1].ravel()
            xyz.append(face)
            normals.append(np.tile(np.eye(3)[axis] * (1.0 - 2.0 * side), (len(face), 1)))
    return np.concatenate(xyz), np.concatenate(normals)


def test_walls_face_the_camera_in_the_room() -> None:
    xyz, inward = room()
    normals = SurfaceGrid.of(xyz.astype(np.float32)).normals(np.array([[2.0, 1.5, 1.5]]))
    agreement = np.einsum("ij,ij->i", normals, inward)
    assert (agreement > 0.0).all() and np.mean(agreement > 0.99) > 0.95


def test_normals_without_points_or_viewpoints() -> None:
    assert SurfaceGrid.of(np.zeros((0, 3))).normals(np.zeros((1, 3))).shape == (0, 3)
    assert not SurfaceGrid.of(room()[0]).normals(np.zeros((0, 3))).any()


def test_the_overview_shows_the_whole_room_from_outside() -> None:
    xyz, inward = room()
    camera = overview_camera(xyz, inward)
    facing = np.einsum("ij,ij->i", inward, camera.centre - xyz) > 0.0
    assert 0.3 < facing.mean() < 0.7
    pixels, depth = camera.project(xyz[facing])
    assert (depth > 0.0).all()
    assert (pixels > 0.0).all() and (pixels < [1280.0, 800.0]).all()
    assert (pixels.max(axis=0) - pixels.min(axis=0)).max() > 600.0
    assert camera.centre[2] > 2.5 and not (np.abs(camera.centre[:2] - [2.0, 1.5]) < [2.0, 1.5]).all()
    assert np.allclose(camera.camera_to_world[:3, :3] @ camera.camera_to_world[:3, :3].T, np.eye(3))
    assert np.linalg.det(camera.camera_to_world[:3, :3]) > 0.0


@pytest.mark.parametrize("origin", [(0, 0, 0), (100, 0, 0), (4000, 5000, 100)])
def test_noise_far_out_of_the_room_does_not_shrink_it_in_the_overview(origin: tuple[int, int, int]) -> None:
    xyz, inward = room()
    xyz = xyz + origin
    noise = np.random.default_rng(0).uniform(-15, 15, (len(xyz) // 120, 3)) + origin
    camera = overview_camera(np.concatenate([xyz, noise]), np.concatenate([inward, np.zeros_like(noise)]))
    facing = np.einsum("ij,ij->i", inward, camera.centre - xyz) > 0.0
    pixels, _ = camera.project(xyz[facing])
    assert (pixels > 0.0).all() and (pixels < [1280.0, 800.0]).all()
    assert (pixels.max(axis=0) - pixels.min(axis=0)).max() > 600.0


def test_the_overview_of_nothing_is_still_a_camera() -> None:
    assert np.isfinite(overview_camera(np.zeros((0, 3)), np.zeros((0, 3))).camera_to_world).all()
