"""Holes of a depth sensor: filled where what surrounds them is a plane, left alone elsewhere."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.scene.hole_filling import HoleFilling, fill_holes

HEIGHT, WIDTH = 48, 64
HOLE = (slice(16, 30), slice(20, 44))
WALL, SCREEN = 1, 2


def plane(normal: tuple[float, float, float], metres: float) -> np.ndarray:
    """Depth float64 [H, W] of a plane seen by a camera 60 degrees wide, ``metres`` off along the optical axis."""
    focal = WIDTH / 2 / np.tan(np.radians(30))
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / focal
    y = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / focal
    rays = np.stack([*np.meshgrid(x, y), np.ones((HEIGHT, WIDTH))], axis=-1)
    return metres * normal[2] / (rays @ np.array(normal))


def measured(true: np.ndarray, noise: float = 0.0, hole: tuple[slice, slice] = HOLE) -> np.ndarray:
    """What a sensor says, float32: noise as a share of the depth, and nothing in the hole."""
    depth = true * (1 + noise * np.random.default_rng(0).standard_normal(true.shape))
    depth[hole] = 0
    return depth.astype(np.float32)


ONE_SEGMENT = np.full((HEIGHT, WIDTH), WALL, np.int32)
FLOOR = plane((0.0, 0.9, 0.3), 2.5)
"""Its depth grows from row to row."""
slanting = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.just(1.0))


@settings(max_examples=40, deadline=None)
@given(slanting, st.floats(0.5, 6), st.integers(2, 30), st.integers(2, 30), st.integers(1, 15), st.integers(1, 15))
def test_a_hole_in_a_plane_is_filled(
    normal: tuple[float, float, float], metres: float, top: int, left: int, height: int, width: int
) -> None:
    true = plane(normal, metres)
    hole = (slice(top, top + height), slice(left, left + width))
    filled = fill_holes(measured(true, hole=hole), ONE_SEGMENT)
    assert filled.dtype == np.float32
    np.testing.assert_allclose(filled, true, rtol=1e-3)


def test_noise_and_a_few_outliers_do_not_move_it() -> None:
    true = plane((0.2, 0.3, 1.0), 3.0)
    depth = measured(true, noise=0.005)
    flying = np.random.default_rng(1).random(depth.shape) < 0.04
    depth[flying & (depth > 0)] *= 0.6
    filled = fill_holes(depth, ONE_SEGMENT)
    np.testing.assert_allclose(filled[HOLE], true[HOLE], rtol=0.01)


def test_a_hole_between_two_depths_stays() -> None:
    """A gap between a chair and the wall far behind it: no plane goes through both."""
    true = np.where(np.arange(WIDTH) < 32, 1.5, 4.0) * np.ones((HEIGHT, 1))
    depth = measured(true, hole=(slice(10, 30), slice(26, 38)))
    np.testing.assert_array_equal(fill_holes(depth, ONE_SEGMENT), depth)


def test_a_hole_ends_where_its_segment_does() -> None:
    """Half of the hole is the wall's, half a near box's: each is filled from its own ring."""
    segments = np.where(np.arange(WIDTH) < 32, WALL, SCREEN).astype(np.int32) * np.ones((HEIGHT, 1), np.int32)
    true = np.where(segments == WALL, FLOOR, 1.0)
    np.testing.assert_allclose(fill_holes(measured(true), segments), true, rtol=1e-3)


def test_a_segment_without_depth_takes_that_of_its_surroundings() -> None:
    """A screen on a wall: black, so the sensor sees nothing of it."""
    segments = ONE_SEGMENT.copy()
    segments[HOLE] = SCREEN
    true = plane((0.3, 0.0, 1.0), 2.0)
    np.testing.assert_allclose(fill_holes(measured(true), segments), true, rtol=1e-3)


def test_a_hole_without_surroundings_stays() -> None:
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    assert not fill_holes(depth, ONE_SEGMENT).any()
    depth[20, 20:25] = 2.0  # too few to say what plane it is
    np.testing.assert_array_equal(fill_holes(depth, ONE_SEGMENT), depth)
    whole = FLOOR.astype(np.float32)
    np.testing.assert_array_equal(fill_holes(whole, ONE_SEGMENT), whole)


def test_a_plane_is_not_carried_far_beyond_what_was_measured() -> None:
    """The upper half of the picture, towards the horizon of a floor."""
    rows = slice(0, 24)
    focal = WIDTH / 2 / np.tan(np.radians(30))
    below = (np.arange(HEIGHT) + 0.5 - 20) / focal  # the horizon is at row 20
    true = np.where(below > 0, 1.5 / np.maximum(below, 1e-9), 0)[:, None] * np.ones((1, WIDTH))
    depth = measured(true, hole=(rows, slice(None)))
    options = HoleFilling()
    filled = fill_holes(depth, ONE_SEGMENT, options)
    ring = depth[24 : 24 + options.ring]
    assert filled[:20].max() == 0, "above the horizon there is no floor"
    assert 0 < filled[rows].max() <= options.stretch * ring.max()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.floats(0, 0.9))
def test_measured_pixels_never_change(seed: int, share: float) -> None:
    random = np.random.default_rng(seed)
    segments = np.kron(random.integers(0, 3, (4, 4)), np.ones((8, 8))).astype(np.int32)
    depth = random.uniform(0.5, 4, 4)[random.integers(0, 4, (4, 4))].repeat(8, 0).repeat(8, 1).astype(np.float32)
    depth *= random.uniform(0.98, 1.02, depth.shape).astype(np.float32)
    depth[random.random(depth.shape) < share] = 0
    before = depth.copy()
    filled = fill_holes(depth, segments)
    np.testing.assert_array_equal(depth, before)
    np.testing.assert_array_equal(filled[before > 0], before[before > 0])
    assert np.isfinite(filled).all() and (filled >= 0).all()
    known = before[before > 0]
    if len(known):
        assert filled.max() <= HoleFilling().stretch * known.max() * 1.001


def test_thousands_of_specks_are_filled_at_once() -> None:
    """With the mean around them: near, if not exact."""
    true = plane((0.1, 0.1, 1.0), 3.0)
    depth = measured(true)
    depth[np.random.default_rng(0).random(depth.shape) < 0.08] = 0
    specks = fill_holes(depth, ONE_SEGMENT)
    assert (specks > 0).all()
    np.testing.assert_allclose(specks, true, rtol=0.02)
