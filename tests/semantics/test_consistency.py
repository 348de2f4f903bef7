"""Pixels that neighbouring views agree with, and pseudo labels."""

import numpy as np

from engine.scene import PanopticMask, Segment
from engine.semantics.consistency import (
    ConsistencyOptions,
    consistency_masks,
    neighbour_indices,
    pseudo_labels,
    view_overlap,
    views_are_sparse,
)
from tests.semantics.plane_views import CHAIR, SOFA, WALL, square, wall_view

PRODUCT = ConsistencyOptions(neighbours=1, agreement=1.0)


def test_the_label_of_an_occluder_does_not_reject_the_wall_behind_it() -> None:
    """The wall alone, and the wall behind a chair that stands 1 m before the second camera."""
    chair = slice(10, 20)
    occluded = wall_view("occluded", 0.6, square(1.0, 3.0, chair), square(CHAIR, WALL, chair))
    kept = next(consistency_masks([wall_view("open", 0.0), occluded], PRODUCT))
    assert kept.all()


def test_one_dissenting_view_rejects_a_label_only_by_the_product_rule() -> None:
    views = [wall_view(str(i), 0.0, classes=SOFA if i == 4 else WALL) for i in range(5)]
    assert not next(consistency_masks(views, ConsistencyOptions(4, 1.0))).any()
    assert next(consistency_masks(views, ConsistencyOptions(4, 0.75))).all()


def test_void_pixels_in_neighbouring_views_do_not_vote() -> None:
    views = [wall_view("a", 0.0, classes=square(0, WALL, slice(5, 9))), wall_view("b", 0.0, classes=0)]
    kept = list(consistency_masks(views, PRODUCT))
    np.testing.assert_array_equal(kept[0], views[0].mask.ids == WALL)
    assert not kept[1].any()


def test_a_label_that_no_neighbouring_view_sees_is_kept() -> None:
    assert next(consistency_masks([wall_view("a", 0.0), wall_view("b", 1.5)], PRODUCT)).all()


def test_neighbouring_views_are_the_nearest_in_recording_order() -> None:
    assert neighbour_indices(5, 10, 4) == [3, 4, 6, 7]
    assert neighbour_indices(0, 10, 4) == [1, 2, 3, 4]
    assert neighbour_indices(9, 10, 4) == [5, 6, 7, 8]
    assert neighbour_indices(1, 3, 8) == [0, 2]
    assert neighbour_indices(5, 10, 0) == []


def test_views_far_apart_count_as_sparse() -> None:
    options = ConsistencyOptions()
    near = [wall_view(str(i), 0.2 * i) for i in range(4)]
    assert view_overlap(near[0], near[0], options) == 1.0
    assert not views_are_sparse(near, options)
    assert views_are_sparse([wall_view(str(i), 2.5 * i) for i in range(4)], options)


def test_tied_region_classes_go_to_the_lower_id() -> None:
    mask = PanopticMask(np.full((4, 8), 1, np.int32), (Segment(1, WALL, False),))
    half = np.where(np.arange(8) < 4, SOFA, CHAIR) * np.ones((4, 1), np.int32)
    assert (pseudo_labels(mask, half.astype(np.int32), 16) == CHAIR).all()
    assert (pseudo_labels(mask, np.zeros((4, 8), np.int32), 16) == 0).all()


def test_small_regions_keep_their_rendered_classes() -> None:
    for width, is_small in ((15, True), (16, False)):
        mask = PanopticMask(np.full((1, width), 1, np.int32), (Segment(1, WALL, False),))
        rendered = np.where(np.arange(width) > 4, 7, 3).astype(np.int32)[None]
        np.testing.assert_array_equal(pseudo_labels(mask, rendered, 16), rendered if is_small else 7)
