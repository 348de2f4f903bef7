"""Keyframes: few views of a long scan, and still every surface is seen often enough."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from engine.instances.agreement import MasksInSpace
from engine.instances.consensus import SIGHTINGS, WORTH_IT, ConsensusOptions, choose_keyframes, objects_of_masks
from engine.instances.records import ObjectMask
from engine.scene import Segment
from tests.instances.two_chairs import CHAIR, WALL

POINTS_A_COLUMN = 4
THING = 7
"""Columns of each segment, so that a view shows several."""


def rows_of_ones(columns: list[np.ndarray], width: int) -> sparse.csr_matrix:
    ends = np.cumsum([0, *map(len, columns)])
    return sparse.csr_matrix((np.ones(ends[-1], np.float32), np.concatenate(columns), ends), (len(columns), width))


def corridor(views: int, sight: int) -> MasksInSpace:
    """Views that pass a long wall with things on it: view v sees the columns v to v + sight - 1. Every other segment is
    a thing, those between are wall."""
    columns = np.repeat(np.arange(views + sight - 1), POINTS_A_COLUMN)
    thing = columns // THING
    masks, view_of_mask, held, seen = [], [], [], []
    for view in range(views):
        rows = np.arange(view * POINTS_A_COLUMN, (view + sight) * POINTS_A_COLUMN)
        seen.append(rows)
        for number in np.unique(thing[rows]).tolist():
            class_id = CHAIR if number % 2 else WALL
            masks.append(ObjectMask(f"{view:04d}", Segment(number + 1, class_id, class_id == CHAIR)))
            view_of_mask.append(view)
            held.append(rows[thing[rows] == number])
    is_thing = np.array([mask.segment.is_thing for mask in masks])
    sight = rows_of_ones(seen, len(columns))
    return MasksInSpace(masks, np.array(view_of_mask), is_thing, rows_of_ones(held, len(columns)), sight, word=sight)


def sightings(space: MasksInSpace, views: np.ndarray) -> np.ndarray:
    return np.asarray(space.sight[views].sum(0)).reshape(-1)


def test_views_with_few_masks_are_all_keyframes() -> None:
    space = corridor(30, 10)
    assert choose_keyframes(space, len(space.masks)).tolist() == list(range(30))
    assert len(choose_keyframes(space, len(space.masks) - 1)) < 30


@pytest.mark.parametrize("most_masks", [1, 40, 300])
def test_few_keyframes_see_every_surface_of_a_scan_often_enough(most_masks: int) -> None:
    space = corridor(400, 18)
    chosen = choose_keyframes(space, most_masks)
    everywhere = sightings(space, np.arange(400))
    found = sightings(space, chosen)
    # A view that would add little is left out, so a few surfaces lack a sighting; none lacks what an object needs.
    assert (found >= np.minimum(everywhere, SIGHTINGS)).mean() > 0.95
    assert (found[everywhere >= SIGHTINGS] >= ConsensusOptions().min_masks).all()
    assert len(chosen) < 0.5 * 400, "views beside each other show the same"


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 40))
def test_no_view_is_left_out_that_shows_much_that_others_do_not(seed: int, most_masks: int) -> None:
    random = np.random.default_rng(seed)
    views, points = 25, 80
    seen = [np.flatnonzero(random.random(points) < random.choice([0.0, 0.05, 0.3])) for _ in range(views)]
    sight = rows_of_ones([rows.astype(np.int32) for rows in seen], points)
    masks = [ObjectMask(str(view), Segment(1, WALL, False)) for view in range(views) for _ in range(2)]
    view_of_mask = np.repeat(np.arange(views), 2)
    space = MasksInSpace(masks, view_of_mask, np.zeros(50, bool), sight[view_of_mask], sight, word=sight)
    chosen = choose_keyframes(space, most_masks)
    assert len(chosen) and (np.diff(chosen) > 0).all()
    lacking = sightings(space, chosen) < np.minimum(sightings(space, np.arange(views)), SIGHTINGS)
    for view in np.setdiff1d(np.arange(views), chosen):
        assert not len(seen[view]) or lacking[seen[view]].mean() <= WORTH_IT


@pytest.mark.parametrize(("views", "sight"), [(2000, 18), (600, 120)])
def test_an_object_in_few_or_many_views_is_found(views: int, sight: int) -> None:
    """Evenly chosen views of so few masks would see one of 18 twice at most; one of 120 has masks in few of them."""
    space = corridor(views, sight)
    options = ConsensusOptions(most_masks=views // 4)
    keyframes = choose_keyframes(space, options.most_masks)
    assert len(keyframes) < 0.4 * views
    objects = objects_of_masks(space.of_views(keyframes), options)
    thing = np.repeat(np.arange(views + sight - 1), POINTS_A_COLUMN) // THING
    inner = sightings(space, np.arange(views)) == sight
    owner = objects.object_of_point[inner]
    assert (owner > 0).all()
    pairs = np.unique(np.column_stack([thing[inner], owner]), axis=0)
    assert len(pairs) == len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])), "each thing is one object"
