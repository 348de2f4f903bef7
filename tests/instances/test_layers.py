"""Detections over the masks: they vote where masks are weak, and a frame's own are held back together with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from engine.instances.agreement import ViewsOnCloud, view_points
from engine.instances.layers import class_agreement, trusted_layers
from engine.instances.superpoints import held_back_agreement
from engine.scene import Evidence, Segment
from tests.instances.test_superpoints import BOX, CLASS_IDS, FLOOR, WALL, box_on_a_floor, seeing


def with_layers(views: ViewsOnCloud, shown: list[NDArray[np.int32]]) -> ViewsOnCloud:
    """The views with two detections of the box each, where ``shown`` says BOX."""
    layered = []
    for view, classes in zip(views.views, shown, strict=True):
        inside = np.array([classes.reshape(1, -1) == BOX] * 2)
        evidence = Evidence((Segment(1, BOX, True, 0.9), Segment(2, BOX, True, 0.3)), inside)
        layered.append(replace(view, layers=evidence.layers()))
    return ViewsOnCloud(layered, views.point_of_pixel, views.seen)


def test_detections_vote_where_masks_are_weak_alone() -> None:
    xyz, is_box = box_on_a_floor()
    true = np.where(is_box, BOX, FLOOR).astype(np.int32)
    # Most of what is seen is floor, on which all agree; what the box is, they do not.
    random = np.random.default_rng(0)
    torn = [np.where(is_box, random.choice([BOX, WALL, FLOOR], len(true)), FLOOR).astype(np.int32) for _ in range(6)]
    for shown, are_weak in ((torn, True), ([true] * 6, False)):
        views = with_layers(seeing(xyz, shown), [true] * 6)
        layers = trusted_layers(views, len(xyz), CLASS_IDS, "pixels")
        assert len(layers.views) == (12 if are_weak else 0)
        for view, seen in zip(layers.views, layers.seen, strict=True):
            assert view.mask.segments[0].class_id == BOX and view.frame in {each.name for each in views.views}
            assert np.array_equal(seen.segment > 0, is_box[seen.row])


def test_each_class_counts_alike() -> None:
    """Against counting point by point."""
    random = np.random.default_rng(1)
    shown = [random.choice([0, FLOOR, FLOOR, BOX, WALL], 50).astype(np.int32) for _ in range(5)]
    views = seeing(np.zeros((50, 3), np.float32), shown)
    share: dict[int, list[bool]] = {each: [] for each in CLASS_IDS}
    for number, one in enumerate(shown):
        others = np.array(shown[:number] + shown[number + 1 :])
        counts = np.array([(others == each).sum(0) for each in CLASS_IDS])
        for point in np.flatnonzero((one > 0) & (counts.sum(0) > 0)):
            share[int(one[point])].append(CLASS_IDS[counts[:, point].argmax()] == one[point])
    expected = np.mean([np.mean(each) for each in share.values()])
    assert class_agreement(views, 50, CLASS_IDS, "views") == pytest.approx(expected)


def test_a_frame_is_held_back_with_its_layers() -> None:
    """Two frames that contradict each other, each confirmed by its own detections: nobody agrees."""
    shown = [np.full(30, each, np.int32) for each in (BOX, WALL)]
    views = with_layers(seeing(np.zeros((30, 3), np.float32), shown), [shown[0]] * 2)
    both = ViewsOnCloud([views.views[1], views.views[1].layer(0)], views.point_of_pixel[:2], views.seen[:2])
    seen = [view_points(view, rows) for view, rows in zip(both.views, both.point_of_pixel, strict=True)]
    both = replace(both, seen=seen)
    assert held_back_agreement(np.arange(30), both, CLASS_IDS, "views") == (0, 0)
    assert both.by_frame() == [[0, 1]]
