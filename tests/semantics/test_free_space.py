"""Where no Gaussian starts: the air before a wall, as near views measure it."""

import numpy as np

from engine.semantics.free_space import in_free_space

from .plane_views import square, wall_view

WALL_AT, AIR, BEHIND, NOWHERE = [0.0, 3.0, 1.0], [0.0, 2.0, 1.0], [0.0, 3.8, 1.0], [0.0, 1.5, 1.0]
VIEWS = [wall_view(f"{number}", 0.1 * number) for number in range(3)]


def test_the_air_before_a_wall_is_free_and_neither_the_wall_nor_what_it_hides_near_it_is() -> None:
    hidden = [0.0, 3.2, 1.0]
    assert in_free_space(np.array([WALL_AT, AIR, hidden]), VIEWS).tolist() == [False, True, False]


def test_what_one_far_view_measures_in_the_air_does_not_outweigh_nearer_views() -> None:
    noisy = wall_view("noisy", 0.0, depth=2.0)
    assert in_free_space(np.array([WALL_AT, AIR]), [*VIEWS, noisy]).tolist() == [False, True]
    assert not in_free_space(np.array([WALL_AT, AIR]), [VIEWS[0], noisy, noisy]).any(), "most views show it"


def test_a_place_that_nothing_shows_stays_only_beside_a_surface() -> None:
    """A dark screen in the wall, whose filled hole gives places in the wall; and a plane extended far into the room."""
    screen = square(0.0, 3.0, slice(18, 23))
    views = [wall_view(f"{number}", 0.0, depth=screen) for number in range(3)]
    places = np.array([[0.0, 3.0, 1.5], [0.25, 3.0, 1.0], [0.0, 3.0, 1.05], NOWHERE])
    assert in_free_space(places, views).tolist() == [False, False, False, True]


def test_a_thin_thing_beside_which_a_view_looks_past_stays() -> None:
    leg = square(2.0, 3.0, slice(20, 21), slice(0, 30))  # one pixel wide: places are rounded to voxels, so beside it
    views = [wall_view(f"{number}", 0.0, depth=leg) for number in range(3)]
    beside = [0.5 * 2.0 / 40.0 + 2.0 / 40.0, 2.0, 1.0]
    assert not in_free_space(np.array([beside, [0.02, 2.0, 1.0], [0.5, 3.0, 1.0]]), views).any()


def test_depth_that_no_view_measured_frees_nothing() -> None:
    assert not in_free_space(np.array([WALL_AT, AIR]), [wall_view("dark", 0.0, depth=0.0)]).any()
