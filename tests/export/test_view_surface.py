"""The surface to look at: far floors are whole, holes of the room are closed, objects are finer than the room."""

from dataclasses import replace
from functools import cache

import numpy as np
import open3d.t.geometry as raycasting
import pytest

from engine.export.fusion import SmallView, Surface, triangle_normals
from engine.export.mending import pieces
from engine.export.mesh import MOST_INSTANCES
from engine.export.view_surface import OBJECTS, ROOM, surface_to_view
from engine.scene import Camera

FLOOR, RUG = 1 * MOST_INSTANCES, 2 * MOST_INSTANCES + 7
HEIGHT, FAR, WIDE = 1.5, 9.0, 1.0
SIZE, FOCAL, MIDDLE = (320, 240), 280.0, 40.0


def look_over_the_floor(hole: bool = False) -> SmallView:
    """A floor that reaches WIDE to each side, seen along it from HEIGHT, with an object at 2 to 3 m and a hole at 4
    m."""
    width, height = SIZE
    camera = Camera(width, height, FOCAL, FOCAL, width / 2, MIDDLE, np.array(
        [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, HEIGHT], [0, 0, 0, 1]]))  # fmt: skip
    below = (np.arange(height) + 0.5 - camera.cy) / camera.fy
    depth = np.where(below > HEIGHT / FAR, HEIGHT / np.maximum(below, 1e-6), 0.0)
    depth = np.repeat(depth[:, None], width, axis=1).astype(np.float32)
    aside = (np.arange(width) + 0.5 - camera.cx) / camera.fx * depth
    depth[np.abs(aside) > WIDE] = 0.0
    if hole:
        depth[(np.abs(aside) < 0.15) & (np.abs(depth - 4.0) < 0.15)] = 0.0
    label = np.where((depth > 2.0) & (depth < 3.0) & (np.abs(aside) < 0.5), RUG, FLOOR)
    return SmallView(camera, depth, np.full((height, width, 3), 128, np.uint8), np.where(depth > 0, label, 0))


def of_a_pole(width: float) -> list[SmallView]:
    """A wall at 2 m, seen by four views side by side, with an object of this width and 1.4 m height before it."""
    views = []
    for x in np.arange(4) * 0.05:
        pose = np.eye(4)
        pose[0, 3] = x
        camera = Camera(*SIZE, 300.0, 300.0, 160.0, 120.0, pose)
        across, down = (np.arange(SIZE[0]) + 0.5 - 160) / 150 + x, (np.arange(SIZE[1]) + 0.5 - 120) / 150
        inside = (abs(across)[None] <= width / 2) & (abs(down)[:, None] <= 0.7)
        depth = np.full(inside.shape, 2.0, np.float32)
        views.append(SmallView(camera, depth, np.zeros((*depth.shape, 3), np.uint8), np.where(inside, RUG, FLOOR)))
    return views


@cache
def floor(views: int = 1) -> tuple[Surface, np.ndarray]:
    return surface_to_view([look_over_the_floor()] * views)


@cache
def pole(width: float) -> tuple[Surface, np.ndarray]:
    return surface_to_view(of_a_pole(width))


def areas(surface: Surface) -> np.ndarray:
    a, b, c = surface.xyz[surface.triangles].astype(float).transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def test_the_mesh_of_a_far_floor_seen_by_one_view_has_no_holes() -> None:
    surface, label = floor()
    nearest = HEIGHT * FOCAL / (SIZE[1] - MIDDLE)
    # A voxel and more is missing along each rim.
    assert areas(surface).sum() == pytest.approx((FAR - nearest) * 2 * WIDE, rel=0.2)
    assert np.abs(surface.xyz[:, 2]).max() < 0.1 and (label > 0).all()


def test_meshes_are_made_of_views_without_objects_labels_or_depth() -> None:
    views = of_a_pole(0.3)
    bare = [replace(view, label=np.full_like(view.label, FLOOR)) for view in views]
    void = [replace(view, label=np.zeros_like(view.label)) for view in views]
    blind = [replace(view, depth=np.zeros_like(view.depth)) for view in views]
    whole = areas(pole(0.3)[0]).sum()
    for given, labels in (
        (bare, {FLOOR}),
        ([*views[:2], bare[2], views[3]], {FLOOR, RUG}),
        ([*views[:2], blind[2], views[3]], {FLOOR, RUG}),
        (void, {0}),
    ):
        surface, label = surface_to_view(given)
        assert areas(surface).sum() == pytest.approx(whole, rel=0.05)
        assert labels <= set(label) <= labels | {0}, "a crumb that touches nothing has no label"
    for given in (blind, []):
        surface, label = surface_to_view(given)
        assert not len(surface.triangles) and not len(label)


@pytest.mark.parametrize("width", [0.02, 0.04, 0.06])
def test_a_thin_pole_is_in_the_mesh(width: float) -> None:
    surface, label = pole(width)
    of_pole = (label[surface.triangles] == RUG).all(axis=1)
    assert areas(surface).sum() == pytest.approx(areas(pole(0.0)[0]).sum(), rel=0.05)
    if width > OBJECTS.voxel:  # what is thinner is not in it
        assert 0.4 < areas(surface)[of_pole].sum() / (width * 1.4) < 1.5


def test_a_hole_in_the_mesh_of_a_room_is_closed() -> None:
    holed, _ = surface_to_view([look_over_the_floor(hole=True)])
    assert areas(holed).sum() == pytest.approx(areas(floor()[0]).sum(), rel=0.01)


def test_meshes_of_objects_are_finer_than_that_of_the_room() -> None:
    surface, label = floor(OBJECTS.least_views)
    size = {value: np.median(areas(surface)[(label[surface.triangles] == value).all(axis=1)]) for value in (FLOOR, RUG)}
    assert size[FLOOR] / size[RUG] == pytest.approx((ROOM.voxel / OBJECTS.voxel) ** 2, rel=0.4)
    assert areas(surface).sum() == pytest.approx(areas(floor()[0]).sum(), rel=0.05)


def test_coarse_triangles_at_an_objects_rim_belong_to_the_room() -> None:
    surface, label = floor(OBJECTS.least_views)
    of_rug = (label[surface.triangles] == RUG).sum(axis=1) >= 2
    assert (areas(surface)[of_rug] > 0.7 * ROOM.voxel**2 / 2).sum() < 0.005 * of_rug.sum()


def test_the_mesh_has_no_gap_where_an_objects_depth_ends_early() -> None:
    whole = look_over_the_floor()
    partly = replace(whole, depth=np.where((whole.label == RUG) & (whole.depth > 2.5), np.float32(0), whole.depth))
    surface, label = surface_to_view([whole] + [partly] * (OBJECTS.least_views - 1))
    rug = surface.triangles[(label[surface.triangles] == RUG).all(axis=1)]
    assert len(set(pieces(rug, len(label))[rug[:, 0]])) == 1, "the coarse rest of an object belongs to its own surface"
    scene = raycasting.RaycastingScene()
    scene.add_triangles(surface.xyz, surface.triangles.astype(np.uint32))
    rays = np.tile(np.array([0.05, 0, 1, 0, 0, -1], np.float32), (200, 1))
    rays[:, 1] = np.linspace(2.2, 2.8, 200)
    assert (scene.cast_rays(rays)["t_hit"].numpy() < 1.1).all()


def test_no_triangle_lies_on_another_or_is_turned_over_where_an_objects_surfaces_are_joined() -> None:
    whole = look_over_the_floor()
    partly = replace(whole, depth=np.where((whole.label == RUG) & (whole.depth > 2.5), np.float32(0), whole.depth))
    for views in ([whole], [whole, partly]):
        surface, _ = surface_to_view([*views, *views[-1:] * (OBJECTS.least_views - len(views))])
        corners = np.sort(np.unique(surface.xyz, axis=0, return_inverse=True)[1].reshape(-1)[surface.triangles])
        assert len(np.unique(corners, axis=0)) == len(corners) and (np.diff(corners) > 0).all()
        assert (triangle_normals(surface.xyz, surface.triangles)[:, 2] < 0).mean() < 0.001


def test_enlarged_depth_follows_planes_and_keeps_edges() -> None:
    view = look_over_the_floor()
    large = view.large_depth(3)
    row = (np.arange(large.shape[0]) + 0.5) / 3
    expected = HEIGHT * view.camera.fy / np.maximum(row - view.camera.cy, 1e-6)
    middle = large[:, large.shape[1] // 2]
    inside = (expected < 0.8 * FAR) & (row < SIZE[1] - 1)
    assert np.allclose(middle[inside], expected[inside], rtol=1e-4)
    last = int(np.argmax(view.depth[:, SIZE[0] // 2] > 0))
    assert (large[3 * last : 3 * last + 3, large.shape[1] // 2] == view.depth[last, SIZE[0] // 2]).all()
    assert ((large > 0) == np.kron(view.depth > 0, np.ones((3, 3), bool))).all()
