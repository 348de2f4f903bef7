"""Labelled sheets cut: straight where the labels end, whole triangles on both sides, nothing lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from engine.export.fusion import Ints, Surface
from engine.export.mending import cut_by_label, even_labels, open_edges
from tests.export.test_mending import STEP, area, sheet


def widest_gap(whole: Surface, cut: Surface) -> float:
    """The largest distance in metres of a vertex on a cut from its nearest copy, which another side has."""
    copies = cut.xyz[len(whole.xyz) :]
    return float(cKDTree(copies).query(copies, k=2)[0][:, 1].max())


def sharp_turns(surface: Surface, triangles: Ints) -> int:
    """How many turns of more than 60 degrees the rim of these triangles [T, 3] makes."""
    rim = open_edges(triangles)
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


def test_parts_meet_without_teeth_gaps_or_overlap() -> None:
    whole = sheet(30, 30)
    label = even_labels(whole.triangles, jagged(whole, (0.8, 0.6)))
    cut, labels = cut_by_label(whole, label)
    corners = labels[cut.triangles]
    assert (corners == corners[:, :1]).all() and len(labels) == len(cut.xyz)
    assert (area(cut) > 0).all() and np.isclose(area(cut).sum(), area(whole).sum(), rtol=0.02)
    assert widest_gap(whole, cut) < 1e-6
    for value in (3, 7):
        assert sharp_turns(cut, cut.triangles[corners[:, 0] == value]) <= 4  # a sheet has corners
        far = (cut.xyz[:, :2] - whole.xyz[:, :2].mean(axis=0)) @ np.array([0.8, 0.6]) * (1 if value == 7 else -1)
        assert far[labels == value].max() < STEP


def test_three_labels_meet_in_a_point() -> None:
    whole = sheet(21, 21)
    x, y = whole.xyz[:, 0] - 0.2, whole.xyz[:, 1] - 0.2
    label = np.where(y < 0, 1, np.where(x < 0, 2, 3))
    cut, labels = cut_by_label(whole, label)
    corners = labels[cut.triangles]
    assert (corners == corners[:, :1]).all()
    assert np.isclose(area(cut).sum(), area(whole).sum(), rtol=0.02)
    assert widest_gap(whole, cut) < 1e-6
    shares = [area(cut)[corners[:, 0] == value].sum() / area(whole).sum() for value in (1, 2, 3)]
    np.testing.assert_allclose(shares, [0.475, 0.2375, 0.2875], atol=0.03)


def test_the_cut_lies_where_labels_count_the_same() -> None:
    whole = sheet(30, 30)
    across = np.array([0.3, 0.954])
    beyond = (whole.xyz[:, :2] - whole.xyz[:, :2].mean(axis=0)) @ across
    cut, _ = cut_by_label(whole, np.where(beyond < 0, 7, 3))
    copies = cut.xyz[len(whole.xyz) :]
    astray = (copies[:, :2] - whole.xyz[:, :2].mean(axis=0)) @ across
    assert astray.std() < 0.12 * STEP  # 0.17 where edges are halved


def test_normals_have_unit_length_and_colours_end_at_the_cut() -> None:
    whole = sheet(20, 20)
    label = np.where(whole.xyz[:, 0] > 0.2, 7, 3)  # on the two sides of a box's edge
    normal = np.where(label[:, None] == 7, np.float32([-1, 0, 0]), np.float32([0, 0, 1]))
    rgb = np.where(label[:, None] == 7, np.uint8([200, 0, 0]), np.uint8([0, 0, 200]))
    cut, labels = cut_by_label(replace(whole, normal=normal, rgb=rgb), label)
    np.testing.assert_allclose(np.linalg.norm(cut.normal, axis=1), 1.0, atol=1e-5)
    assert ((cut.rgb[:, 0] == 200) == (labels == 7)).all()


def test_a_surface_of_one_label_keeps_its_triangles() -> None:
    whole = sheet(5, 5)
    cut, labels = cut_by_label(whole, np.full(25, 4))
    np.testing.assert_array_equal(cut.triangles, whole.triangles)
    assert (labels == 4).all()


def test_a_vertex_among_others_takes_their_label() -> None:
    whole = sheet(9, 9)
    label = np.full(81, 5)
    label[40] = 9
    assert (even_labels(whole.triangles, label) == 5).all()
