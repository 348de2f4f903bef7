"""Neighbouring points of one surface, of which the views' outlines decide."""

from __future__ import annotations

import numpy as np

from engine.instances.agreement import ViewPoints
from engine.instances.segment_votes import neighbours_on_a_thing

SPACING = 0.05
WIDTH = 6
XYZ = np.array([[SPACING * x, SPACING * y, 0.0] for y in range(3) for x in range(WIDTH)], np.float32)
LEFT = np.arange(len(XYZ)) % WIDTH < WIDTH // 2


def seen_as(segment: np.ndarray, resolution: float, rows: np.ndarray | None = None) -> ViewPoints:
    """A view that shows these segments at the points ``rows`` (all)."""
    row = np.arange(len(XYZ)) if rows is None else rows
    return ViewPoints(
        row.astype(np.int32),
        segment[row].astype(np.int32),
        np.ones(len(row), np.float32),
        np.full(len(row), resolution, np.float32),
    )


WALL, PICTURE = np.ones(len(XYZ)), np.where(LEFT, 1, 2)


def crosses(views: list[ViewPoints]) -> bool:
    """Whether any point left has a neighbour to the right."""
    return bool(neighbours_on_a_thing(XYZ, SPACING, views)[LEFT][:, ~LEFT].nnz)


def test_an_outline_parts_neighbours_where_most_views_draw_it_by_what_they_resolve() -> None:
    assert crosses([seen_as(WALL, 1.0)]) and not crosses([seen_as(PICTURE, 1.0)])
    assert not crosses([seen_as(PICTURE, 3.0), seen_as(WALL, 1.0), seen_as(WALL, 1.0)])
    assert crosses([seen_as(PICTURE, 1.0), seen_as(WALL, 1.0), seen_as(WALL, 1.0)])
    assert not crosses([seen_as(PICTURE, 1.0), seen_as(np.where(LEFT, 0, 1), 9.0)]), "void says nothing"


def test_the_weights_of_a_points_neighbours_are_one_together() -> None:
    weights = neighbours_on_a_thing(XYZ, SPACING, [seen_as(WALL, 1.0)])
    np.testing.assert_allclose(np.asarray(weights.sum(1)).reshape(-1), 1.0, rtol=1e-6)
    assert weights.diagonal().max() == 0.0 and (weights.getnnz(1) <= 6).all()
    there = XYZ[weights.tocoo().row] - XYZ[weights.tocoo().col]
    assert np.linalg.norm(there, axis=1).max() <= 2 * SPACING + 1e-6


def test_points_that_no_view_shows_together_have_no_neighbours() -> None:
    half = seen_as(WALL, 1.0, np.flatnonzero(LEFT)), seen_as(WALL, 1.0, np.flatnonzero(~LEFT))
    assert not crosses([*half])
    assert neighbours_on_a_thing(XYZ, SPACING, []).nnz == 0
    alone = np.concatenate([XYZ, [[9.0, 9.0, 9.0]]])
    assert neighbours_on_a_thing(alone, SPACING, [seen_as(WALL, 1.0)]).getnnz(1)[-1] == 0
