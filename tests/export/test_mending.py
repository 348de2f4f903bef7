"""Surfaces mended and cut: no flakes, tatters and small holes; straight where labels end, nothing lost."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from engine.export import mending
from engine.export.fusion import Ints, SmallView, Surface
from engine.scene import Camera

STEP = 0.02
"""Metres between the vertices of a sheet."""


def sheet(columns: int, rows: int, x: float = 0.0) -> Surface:
    """A flat grid from (x, 0), facing up."""
    row, column = np.mgrid[:rows, :columns]
    xyz = np.stack([x + STEP * column, STEP * row, 0 * row], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (row * columns + column)[:-1, :-1].ravel()
    quads = corner[:, None] + np.array([0, 1, columns + 1, columns])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int64)
    rgb = np.full(xyz.shape, 100, np.uint8)
    return Surface(xyz, rgb, np.tile(np.float32([0, 0, 1]), (len(xyz), 1)), triangles)


def joined(*parts: Surface) -> Surface:
    starts = np.cumsum([0, *(len(part.xyz) for part in parts)])
    return Surface(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("xyz", "rgb", "normal")),
        np.concatenate([part.triangles + start for part, start in zip(parts, starts[:-1], strict=True)]),
    )


def with_hole(surface: Surface, low: float, high: float) -> Surface:
    """Without the triangles whose middle lies between these metres, in x and y."""
    middle = surface.xyz[surface.triangles].mean(axis=1)[:, :2]
    inside = ((middle > low) & (middle < high)).all(axis=1)
    return Surface(surface.xyz, surface.rgb, surface.normal, surface.triangles[~inside])


def area(surface: Surface) -> NDArray[np.float64]:
    """Of the triangles seen from above, negative for those that face down."""
    a, b, c = surface.xyz[surface.triangles].astype(np.float64).transpose(1, 0, 2)
    return np.cross(b - a, c - a)[:, 2] / 2


def test_a_small_hole_in_a_mesh_is_closed_and_faces_as_its_surroundings() -> None:
    whole = sheet(30, 30)
    torn = with_hole(whole, 0.2, 0.28)
    label = np.where(torn.xyz[:, 0] < 0.25, 7, 9)
    closed, labels = mending.close_holes(torn, label)
    assert len(closed.xyz) == len(whole.xyz) + 1
    assert len(mending.open_edges(closed.triangles)) == len(mending.open_edges(whole.triangles))
    assert (area(closed) > 0).all() and np.isclose(area(closed).sum(), area(whole).sum())
    np.testing.assert_allclose(closed.xyz[-1], [0.24, 0.24, 0], atol=1e-6)
    np.testing.assert_allclose(closed.normal[-1], [0, 0, 1], atol=1e-6)
    assert labels[-1] == 7 and (closed.rgb == 100).all()


def test_large_holes_and_outer_rims_of_a_mesh_stay_open() -> None:
    torn = joined(with_hole(sheet(30, 30), 0.2, 0.36), sheet(4, 4, x=1.0))  # a hole of 0.16 m, a scrap of 0.06 m
    label = np.zeros(len(torn.xyz), np.int64)
    closed, labels = mending.close_holes(torn, label)
    assert len(closed.triangles) == len(torn.triangles) and len(labels) == len(label)


def test_small_mesh_pieces_far_from_their_object_take_a_neighbours_label() -> None:
    surface = joined(sheet(60, 20), sheet(4, 4, x=3.0), sheet(5, 5, x=0.6 + 0.64))
    label = np.full(len(surface.xyz), 5, np.int64)
    on_sheet = surface.xyz[:, 0] < 1.19
    label[on_sheet & (surface.xyz[:, 0] < 0.6)] = 3  # the object; a patch of its label far over on the other
    patch = on_sheet & (surface.xyz[:, 0] > 1.0) & (surface.xyz[:, 0] < 1.07) & (surface.xyz[:, 1] < 0.07)
    label[patch] = 3
    label[~on_sheet] = np.where(surface.xyz[~on_sheet, 0] > 2, 3, 5)  # alone and far; alone and near its large piece
    mended = mending.without_crumbs(surface, label, np.zeros(len(label), np.bool_))
    assert (mended[patch] == 5).all()
    assert (mended[surface.xyz[:, 0] > 2] == 0).all()
    others = ~patch & (surface.xyz[:, 0] < 2)
    np.testing.assert_array_equal(mended[others], label[others])


def test_a_large_mesh_piece_of_stuff_keeps_its_label() -> None:
    surface = sheet(120, 20)
    x = surface.xyz[:, 0]
    label = np.where(x < 1.8, 3, np.where(x < 2.29, 5, 3))  # wall, a picture, and the wall behind it
    np.testing.assert_array_equal(mending.without_crumbs(surface, label, label == 3), label)
    assert (mending.without_crumbs(surface, label, label == 0)[x > 2.29] == 5).all()


def test_small_floating_flakes_are_left_out_of_a_mesh() -> None:
    surface = joined(sheet(20, 20), sheet(6, 6, x=2.0), sheet(12, 12, x=4.0))
    kept, label = mending.without_flakes(surface, np.repeat([1, 2, 3], [400, 36, 144]))
    assert np.bincount(label).tolist() == [0, 400, 0, 144]
    assert np.isclose(area(kept).sum(), (19 * STEP) ** 2 + (11 * STEP) ** 2)


def test_smoothing_a_mesh_rim_moves_no_inner_vertex() -> None:
    whole = sheet(20, 20)
    row = np.arange(len(whole.xyz)) // 20
    teeth = (row[whole.triangles] >= 10).sum(axis=1) >= 2  # as labels cut a surface
    surface = Surface(whole.xyz, whole.rgb, whole.normal, whole.triangles[teeth])
    edges = mending.open_edges(surface.triangles)
    sides = edges[(np.abs(whole.xyz[edges][..., 0] - 0.19) < 0.15).all(axis=1) & (row[edges] < 12).all(axis=1)]
    even = mending.even_rim(surface)
    before, after = (np.abs(np.diff(xyz[sides][..., 1], axis=1)).max() for xyz in (surface.xyz, even))
    assert before > 0.9 * STEP and after < 0.2 * before
    within = np.setdiff1d(np.arange(len(whole.xyz)), edges)
    np.testing.assert_array_equal(even[within], whole.xyz[within])


def test_small_mesh_scraps_near_an_object_go_but_its_legs_stay() -> None:
    surface = joined(sheet(30, 30), sheet(4, 4, x=0.62), sheet(6, 6, x=0.72))  # 1.1 % and 3 % of the sheet
    label = np.full(len(surface.xyz), 3, np.int64)
    mended = mending.without_crumbs(surface, label, np.zeros(len(label), np.bool_))
    np.testing.assert_array_equal(np.bincount(mended, minlength=4)[[0, 3]], [16, 936])
    assert (mending.without_crumbs(surface, label, np.ones(len(label), np.bool_)) == 3).all()


def test_removing_narrow_strips_of_a_mesh_does_not_enlarge_holes() -> None:
    whole = with_hole(sheet(40, 40), 0.3, 0.48)
    torn = with_tongue(whole)
    kept, label = mending.without_fringe(torn, np.full(len(torn.xyz), 3))
    assert kept.xyz[:, 0].max() < 0.79 + 2 * STEP and (label == 3).all() and len(label) == len(kept.xyz)
    of_sheet = kept.xyz[kept.triangles][..., 0].max(axis=1) < 0.785
    assert np.isclose(area(kept)[of_sheet].sum(), area(whole).sum(), rtol=0.01)


def with_tongue(whole: Surface) -> Surface:
    """With a tongue of three vertices' width, joined to the sheet's right side where both have a vertex."""
    tongue = sheet(20, 3, x=0.78)
    both = joined(whole, Surface(tongue.xyz + np.float32([0, 0.2, 0]), tongue.rgb, tongue.normal, tongue.triangles))
    _, first, number = np.unique(both.xyz.round(4), axis=0, return_index=True, return_inverse=True)
    return Surface(both.xyz[first], both.rgb[first], both.normal[first], number.ravel()[both.triangles])


def test_removing_mesh_fringes_keeps_thin_objects() -> None:
    for surface in (sheet(200, 3), joined(sheet(30, 30), sheet(20, 3, x=2.0)), with_tongue(sheet(40, 40))):
        label = np.where(surface.xyz[:, 0] > 0.785, 7, 5)
        label[np.abs(surface.xyz[:, 0] - surface.xyz[:, 0].max() + 0.1).argmin()] = 0
        kept, labels = mending.without_fringe(surface, label)
        of_thin = [area(each)[(each.xyz[each.triangles][..., 0] > 0.785).all(axis=1)].sum() for each in (surface, kept)]
        assert np.isclose(*of_thin) and (labels == 7).sum() == (label == 7).sum()


def widest_gap(whole: Surface, cut: Surface) -> float:
    """The largest distance in metres of a vertex on a cut from its nearest copy, which another side has."""
    copies = cut.xyz[len(whole.xyz) :]
    return float(cKDTree(copies).query(copies, k=2)[0][:, 1].max())


def sharp_turns(surface: Surface, triangles: Ints) -> int:
    """How many turns of more than 60 degrees the rim of these triangles [T, 3] makes."""
    rim = mending.open_edges(triangles)
    following = np.full(len(surface.xyz), -1)
    following[rim[:, 0]] = rim[:, 1]
    way = surface.xyz[rim[:, 1]] - surface.xyz[rim[:, 0]]
    on = surface.xyz[following[rim[:, 1]]] - surface.xyz[rim[:, 1]]
    cosine = (way * on).sum(axis=1) / np.maximum(np.linalg.norm(way, axis=1) * np.linalg.norm(on, axis=1), 1e-12)
    return int((cosine < 0.5).sum())


def jagged(surface: Surface, towards: tuple[float, float]) -> Ints:
    """Label 7 up to a slanted line through the sheet's middle, as views vote it with vertices astray, 3 beyond."""
    beyond = (surface.xyz[:, :2] - surface.xyz[:, :2].mean(axis=0)) @ np.array(towards)
    return np.where(beyond + np.random.default_rng(0).normal(0, 0.4 * STEP, len(beyond)) < 0, 7, 3)


def test_mesh_parts_cut_by_label_meet_without_gaps_or_overlap() -> None:
    whole = sheet(30, 30)
    label = mending.even_labels(whole.triangles, jagged(whole, (0.8, 0.6)))
    cut, labels = mending.cut_by_label(whole, label)
    corners = labels[cut.triangles]
    assert (corners == corners[:, :1]).all() and len(labels) == len(cut.xyz)
    assert (area(cut) > 0).all() and np.isclose(area(cut).sum(), area(whole).sum(), rtol=0.02)
    assert widest_gap(whole, cut) < 1e-6
    for value in (3, 7):
        assert sharp_turns(cut, cut.triangles[corners[:, 0] == value]) <= 4  # a sheet has corners
        far = (cut.xyz[:, :2] - whole.xyz[:, :2].mean(axis=0)) @ np.array([0.8, 0.6]) * (1 if value == 7 else -1)
        assert far[labels == value].max() < STEP


def test_mesh_parts_of_three_labels_meet_in_one_point() -> None:
    whole = sheet(21, 21)
    x, y = whole.xyz[:, 0] - 0.2, whole.xyz[:, 1] - 0.2
    label = np.where(y < 0, 1, np.where(x < 0, 2, 3))
    cut, labels = mending.cut_by_label(whole, label)
    corners = labels[cut.triangles]
    assert (corners == corners[:, :1]).all()
    assert np.isclose(area(cut).sum(), area(whole).sum(), rtol=0.02)
    assert widest_gap(whole, cut) < 1e-6
    shares = [area(cut)[corners[:, 0] == value].sum() / area(whole).sum() for value in (1, 2, 3)]
    np.testing.assert_allclose(shares, [0.475, 0.2375, 0.2875], atol=0.03)


def test_cut_mesh_parts_have_unit_normals_and_unmixed_colours() -> None:
    whole = sheet(20, 20)
    label = np.where(whole.xyz[:, 0] > 0.2, 7, 3)  # on the two sides of a box's edge
    normal = np.where(label[:, None] == 7, np.float32([-1, 0, 0]), np.float32([0, 0, 1]))
    rgb = np.where(label[:, None] == 7, np.uint8([200, 0, 0]), np.uint8([0, 0, 200]))
    cut, labels = mending.cut_by_label(replace(whole, normal=normal, rgb=rgb), label)
    np.testing.assert_allclose(np.linalg.norm(cut.normal, axis=1), 1.0, atol=1e-5)
    assert ((cut.rgb[:, 0] == 200) == (labels == 7)).all()


def seen_from(x: float, height: float, depth: np.ndarray | float) -> SmallView:
    """A view straight down from (x, 0.2) at this height, of a picture with this depth."""
    pose = np.array([[1.0, 0, 0, x], [0, -1, 0, 0.2], [0, 0, -1, height], [0, 0, 0, 1]])
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0, pose)
    shown = np.broadcast_to(np.float32(depth), (100, 100)).copy()
    return SmallView(camera, shown, np.zeros((100, 100, 3), np.uint8), np.ones((100, 100), np.int64))


def test_mesh_surface_seen_through_or_only_from_behind_is_removed() -> None:
    floor = sheet(20, 20)
    flap = replace(sheet(20, 20), xyz=sheet(20, 20).xyz + np.float32([0, 0, 0.5]))  # above it: all see the floor
    below = replace(sheet(20, 20), normal=-sheet(20, 20).normal)  # the floor's own place, facing away
    views = [seen_from(x, 1.5, 1.5) for x in (0.1, 0.2, 0.3)]
    for surface, kept in ((floor, 1.0), (flap, 0.0), (below, 0.0)):
        label = np.ones(len(surface.xyz), np.int64)
        left, of_left = mending.without_flaps(surface, label, views)
        assert len(left.triangles) == kept * len(surface.triangles) and len(of_left) == len(left.xyz)
    label = np.ones(len(below.xyz), np.int64)
    assert len(mending.without_flaps(below, label, views, -1.0)[0].triangles) == len(below.triangles)
    unseen = mending.without_flaps(floor, label, [seen_from(0.2, 1.5, 0.7)], -1.0)[0]
    assert len(unseen.triangles) == len(floor.triangles), "something is in the way: nothing is known of it"


def test_mesh_pieces_of_few_triangles_go_unless_nothing_else_is_left() -> None:
    large, small = sheet(20, 20), sheet(6, 6, x=0.5)
    both = joined(large, small)
    label = np.ones(len(both.xyz), np.int64)
    stuff = np.ones(len(label), np.bool_)
    found = mending.without_crumbs(both, label, stuff, 100)
    assert (found[: len(large.xyz)] == 1).all() and (found[len(large.xyz) :] == 0).all()
    assert (mending.without_crumbs(both, label, stuff, 10) == 1).all()
    alone = np.ones(len(small.xyz), np.int64)
    assert (mending.without_crumbs(small, alone, alone < 0, 100) == 1).all()
