"""Segments as points in space, and the masks that matched segments give points."""

from dataclasses import replace

import numpy as np

from engine.instances.segments import SegmentOptions, local_instances, mask_extents, outline_of, vote_instances
from engine.scene import Camera, PanopticMask, Segment, View
from tests.instances.two_chairs import THINGS, WALL, look, view_of

CHAIR_BOX = ((-0.3, -0.3, 0.0), (0.3, 0.3, 0.8))


def test_only_large_segments_of_thing_classes_become_objects() -> None:
    view = view_of("a", look((0, -3, 1.5), (0, 0, 0.4), (160, 120)), [CHAIR_BOX])
    found = local_instances(view, THINGS, SegmentOptions(0.05))
    assert [item.masks[0].segment.id for item in found] == [2]
    assert len(local_instances(view, frozenset({WALL}), SegmentOptions(0.05))) == 1
    assert not local_instances(view, THINGS, SegmentOptions(0.05, min_points=10**6))


def test_a_segment_that_may_be_several_objects_becomes_no_object() -> None:
    view = view_of("a", look((0, -3, 1.5), (0, 0, 0.4), (160, 120)), [CHAIR_BOX])
    groups = tuple(replace(segment, is_thing=False, is_group=True) for segment in view.mask.segments)
    assert not local_instances(replace(view, mask=PanopticMask(view.mask.ids, groups)), THINGS, SegmentOptions(0.05))


def test_eroding_masks_removes_spilt_edges_but_keeps_small_segments() -> None:
    camera = look((0, -3, 1.5), (0, 0, 0.4), (160, 120))
    bleeding = view_of("a", camera, [CHAIR_BOX], bleed=1)
    assert local_instances(bleeding, THINGS, SegmentOptions(0.05))[0].box.size[0] < 0.75
    assert local_instances(bleeding, THINGS, SegmentOptions(0.05, erosion_share=0.0))[0].box.size[0] > 1.5
    whole = local_instances(bleeding, THINGS, SegmentOptions(0.05, min_eroded=10**6))[0]
    assert whole.box.size[0] > 1.5


def test_a_masks_outline_goes_around_all_but_its_smallest_parts() -> None:
    ids = np.zeros((100, 200), np.int32)
    ids[20:40, 50:100], ids[60:80, 150:170], ids[0:4, 0:4] = 7, 7, 7
    first, second = sorted(outline_of(PanopticMask(ids, ()), 7).split(";"))
    assert sorted(first.split()) == ["0.253,0.205", "0.253,0.395", "0.497,0.205", "0.497,0.395"]
    assert len(second.split()) == 4 and second.startswith("0.752,")
    assert outline_of(PanopticMask(ids, ()), 9) == ""


def test_mask_extents_give_area_and_place_of_each_mask_in_the_picture() -> None:
    ids = np.zeros((10, 20), np.int32)
    ids[2:4, 5:10], ids[9, 0], ids[0, 19] = 7, 900_000, 900_000
    assert mask_extents(PanopticMask(ids, ())) == {
        7: (10 / 200, (0.25, 0.2, 0.5, 0.4)),
        900_000: (2 / 200, (0.0, 0.0, 1.0, 1.0)),
    }
    assert mask_extents(PanopticMask(np.zeros((4, 4), np.int32), ())) == {}


CAMERA = Camera(4, 1, 1.0, 1.0, 2.0, 0.5, np.eye(4))


def view(name: str, ids: list[int]) -> View:
    segments = tuple(Segment(i, 5, True) for i in sorted(set(ids)) if i)
    mask = PanopticMask(np.array([ids], np.int32), segments)
    return View(name, CAMERA, np.zeros((1, 4, 3), np.uint8), np.ones((1, 4), np.float32), mask)


def test_each_view_has_one_vote_on_the_object_of_a_point() -> None:
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


def test_tied_votes_go_to_the_lower_object_id() -> None:
    views = [view("a", [9, 9, 9, 9]), view("b", [9, 9, 9, 9])]
    rows = np.array([[0, 0, 1, 1]], np.int32)
    assert vote_instances(views, lambda v: rows, 2, {("a", 9): 4, ("b", 9): 3}).tolist() == [3, 3]
    assert vote_instances(views, lambda v: rows, 2, {}).tolist() == [0, 0]
