from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.instances.records import OrientedBox, fit_box, intersection_volume


def box(centre: tuple[float, float, float], size: tuple[float, float, float], yaw: float) -> OrientedBox:
    return OrientedBox(np.array(centre), np.array(size), yaw)


def inside(box: OrientedBox, points: np.ndarray) -> np.ndarray:
    cos, sin = math.cos(box.yaw), math.sin(box.yaw)
    local = (points - box.centre) @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return (np.abs(local) <= box.size / 2).all(1)


lengths = st.floats(0.2, 2.0)
boxes = st.builds(
    lambda x, y, z, a, b, c, yaw: box((x, y, z), (a, b, c), yaw),
    *[st.floats(-0.8, 0.8)] * 3, lengths, lengths, lengths, st.floats(-1.5, 1.5),
)  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(boxes, boxes)
def test_the_intersection_agrees_with_monte_carlo(first: OrientedBox, second: OrientedBox) -> None:
    half = first.size / 2
    local = np.random.default_rng(0).uniform(-half, half, (20000, 3))
    cos, sin = math.cos(first.yaw), math.sin(first.yaw)
    points = local @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + first.centre
    share = inside(second, points).mean()
    expected = share * first.volume
    volume = intersection_volume(first, second)
    assert volume == pytest.approx(expected, abs=0.02 * first.volume)
    assert volume == pytest.approx(intersection_volume(second, first), abs=1e-9)
    assert -1e-12 <= volume <= min(first.volume, second.volume) + 1e-9
    assert intersection_volume(first, first) == pytest.approx(first.volume)


def test_a_turned_square_cuts_an_octagon() -> None:
    one, turned = box((0, 0, 0), (2, 2, 1), 0.0), box((0, 0, 0.5), (2, 2, 1), math.pi / 4)
    assert intersection_volume(one, turned) == pytest.approx(0.5 * 8 * (math.sqrt(2) - 1))
    assert intersection_volume(one, box((0, 0, 1.1), (2, 2, 1), 0.3)) == 0.0


@settings(max_examples=40, deadline=None)
@given(boxes, st.integers(0, 1000))
def test_a_box_is_found_again_from_its_points(original: OrientedBox, seed: int) -> None:
    points = np.concatenate([original.corners, original.centre[None]]) + [100.0, -50.0, 7.0]
    found = fit_box(np.random.default_rng(seed).permutation(points), 0.01)
    assert found.volume == pytest.approx(original.volume, rel=1e-3)
    np.testing.assert_allclose(found.centre, original.centre + [100.0, -50.0, 7.0], atol=1e-4)
    assert found.size[0] >= found.size[1] and -math.pi / 2 <= found.yaw < math.pi / 2
    moved = OrientedBox(found.centre, found.size + 1e-3, found.yaw)
    assert inside(moved, points).all()


def test_thin_things_have_a_least_thickness() -> None:
    flat = fit_box(np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0]]), 0.05)
    np.testing.assert_allclose(flat.size, [2.0, 0.05, 0.05])
    assert flat.yaw == pytest.approx(0.0)
    with pytest.raises(ValueError, match="point"):
        fit_box(np.zeros((0, 3)), 0.05)


def test_the_rotation_is_the_yaw_as_a_quaternion() -> None:
    w, x, y, z = box((0, 0, 0), (1, 1, 1), math.pi / 2).rotation
    assert (w, x, y, z) == pytest.approx((math.sqrt(0.5), 0, 0, math.sqrt(0.5)))
