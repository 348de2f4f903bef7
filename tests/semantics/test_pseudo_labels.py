from __future__ import annotations

import numpy as np

from engine.scene import PanopticMask, Segment
from engine.semantics.consistency import LEAST_AREA, pseudo_labels, regions

WALL, CHAIR, SOFA = 1, 5, 6


def two_chairs() -> PanopticMask:
    """Wall with two chairs that touch, a third that touches one by a corner only, and void at the bottom."""
    ids = np.full((12, 16), 1, np.int32)
    ids[0:4, 0:6], ids[0:4, 6:12], ids[4:8, 12:16] = 2, 3, 4
    ids[10:] = 0
    return PanopticMask(ids, (Segment(1, WALL, False), *(Segment(i, CHAIR, True) for i in (2, 3, 4))))


def test_regions_split_by_class_at_corners_but_not_between_touching_chairs() -> None:
    region = regions(two_chairs())
    assert region[0, 0] == region[0, 11] != region[5, 13]
    # The two chairs and the third, which meet at a corner, cut the wall in two.
    assert region[0, 13] != region[5, 0]
    assert (region[10:] == 0).all() and region.max() == 4


def test_a_region_takes_the_majority_of_the_rendered_classes() -> None:
    mask = two_chairs()
    rendered = np.full((12, 16), WALL, np.int32)
    rendered[0:4, 0:12] = CHAIR
    rendered[0:4, 0:6] = SOFA
    rendered[0, 11] = 0
    # 24 sofa against 23 chair pixels in the joint region.
    label = pseudo_labels(mask, rendered)
    assert (label[0:4, 0:12] == SOFA).all() and (label[10:] == 0).all()
    assert (label[4:8, 12:16] == WALL).all()


def test_ties_go_to_the_lower_class_and_unrendered_regions_have_no_loss() -> None:
    mask = PanopticMask(np.full((4, 8), 1, np.int32), (Segment(1, WALL, False),))
    half = np.where(np.arange(8) < 4, SOFA, CHAIR) * np.ones((4, 1), np.int32)
    assert (pseudo_labels(mask, half.astype(np.int32)) == CHAIR).all()
    assert (pseudo_labels(mask, np.zeros((4, 8), np.int32)) == 0).all()


def test_small_regions_keep_what_is_rendered() -> None:
    for width, is_small in ((LEAST_AREA - 1, True), (LEAST_AREA, False)):
        mask = PanopticMask(np.full((1, width), 1, np.int32), (Segment(1, WALL, False),))
        rendered = np.where(np.arange(width) > 4, 7, 3).astype(np.int32)[None]
        np.testing.assert_array_equal(pseudo_labels(mask, rendered), rendered if is_small else 7)
