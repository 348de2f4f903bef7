from __future__ import annotations

import numpy as np

from engine.instances.segments import instance_map, restrict_to_things, vote_instances
from engine.scene import Camera, PanopticMask, Segment, View

CAMERA = Camera(4, 1, 1.0, 1.0, 2.0, 0.5, np.eye(4))


def view(name: str, ids: list[int]) -> View:
    segments = tuple(Segment(i, 5, True) for i in sorted(set(ids)) if i)
    mask = PanopticMask(np.array([ids], np.int32), segments)
    return View(name, CAMERA, np.zeros((1, 4, 3), np.uint8), np.ones((1, 4), np.float32), mask)


def test_segments_become_their_instances() -> None:
    found = instance_map(view("a", [0, 3, 70000, 3]), {("a", 3): 2, ("b", 70000): 5})
    assert found.tolist() == [[0, 2, 0, 2]]


def test_each_view_has_one_vote_per_point() -> None:
    near, far, other = view("near", [1, 1, 1, 2]), view("far", [2, 0, 0, 2]), view("other", [2, 2, 2, 0])
    # The near view sees point 0 with three pixels, the two others with one each.
    rows = {
        "near": np.array([[0, 0, 0, 1]], np.int32),
        "far": np.array([[0, -1, 2, 1]], np.int32),
        "other": np.array([[0, -1, -1, -1]], np.int32),
    }
    matched = {("near", 1): 1, ("near", 2): 2, ("far", 2): 2, ("other", 2): 2}
    found = vote_instances([near, far, other], lambda v: rows[v.name], 4, matched)
    assert found.tolist() == [2, 2, 0, 0]


def test_ties_go_to_the_lower_id_and_no_match_is_none() -> None:
    views = [view("a", [9, 9, 9, 9]), view("b", [9, 9, 9, 9])]
    rows = np.array([[0, 0, 1, 1]], np.int32)
    assert vote_instances(views, lambda v: rows, 2, {("a", 9): 4, ("b", 9): 3}).tolist() == [3, 3]
    assert vote_instances(views, lambda v: rows, 2, {}).tolist() == [0, 0]


def test_matched_masks_cover_things_only() -> None:
    instance, classes = np.array([[1, 1, 2, 0]], np.int32), np.array([[5, 1, 0, 5]], np.int32)
    assert restrict_to_things(instance, classes, {5}).tolist() == [[1, 0, 0, 0]]
