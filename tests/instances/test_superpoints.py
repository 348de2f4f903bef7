"""Superpoints, and detections over masks: used only if views that are held back prefer them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from engine.instances import superpoints as module
from engine.instances.agreement import ViewPoints, ViewsOnCloud, shown_classes, view_points, votes_of_views
from engine.instances.objects import vote_classes
from engine.instances.segment_votes import _votes
from engine.instances.superpoints import (
    AGREEING,
    RestOfSuperpoint,
    held_back_agreement,
    rest_of_superpoints,
    superpoints,
    trusted_superpoints,
)
from engine.instances.weak_masks import DOUBTED, WEAK, agreement_of_views, class_balance
from engine.scene import Camera, Evidence, PanopticMask, Segment, View

FLOOR, BOX, WALL = 1, 2, 3
SPACING = 0.05
CLASS_IDS = (FLOOR, BOX, WALL)


def box_on_a_floor() -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A floor of 2 x 2 m with a box of 0.5 m on it, a point every 5 cm, and which points are the box's."""
    side = np.arange(0.0, 2.0, SPACING)
    x, y = (each.reshape(-1) for each in np.meshgrid(side, side))
    inside = (np.abs(x - 1) < 0.25) & (np.abs(y - 1) < 0.25)
    floor = np.stack([x, y, np.zeros_like(x)], 1)[~inside]
    top = np.stack([x, y, np.full_like(x, 0.5)], 1)[inside]
    edge = [(a, b) for a in np.arange(0.75, 1.2501, SPACING) for b in (0.75, 1.25)]
    rim = np.array([(a, b) for a, b in edge] + [(b, a) for a, b in edge])
    walls = np.concatenate([np.column_stack([rim, np.full(len(rim), z)]) for z in np.arange(SPACING, 0.5, SPACING)])
    xyz = np.concatenate([floor, top, walls]).astype(np.float32)
    count = len(xyz)
    return xyz, np.arange(count) >= len(floor)


def seeing(xyz: NDArray[np.float32], shown: list[NDArray[np.int32]]) -> ViewsOnCloud:
    """Views from above the corners that see every point once, each with the class that it shows there."""
    views, seen = [], []
    for number, classes in enumerate(shown):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.diag([1.0, -1.0, -1.0]), (2.0 * (number % 2), 2.0 * (number // 2 % 2), 3.0)
        ids = classes.reshape(1, -1)
        mask = PanopticMask(ids, tuple(Segment(int(each), int(each), False) for each in np.unique(ids) if each))
        depth = np.ones(ids.shape, np.float32)
        camera = Camera(ids.shape[1], 1, 1.0, 1.0, 0.5, 0.5, pose)
        views.append(View(str(number), camera, np.zeros((*ids.shape, 3), np.uint8), depth, mask))
        row = np.arange(len(xyz), dtype=np.int32)
        one = np.ones(len(row), np.float32)
        seen.append(ViewPoints(row, classes.astype(np.int32), one, one))
    return ViewsOnCloud(views, [np.arange(len(xyz), dtype=np.int32)[None]] * len(views), seen)


def test_superpoints_separate_a_box_from_the_floor_below_it() -> None:
    xyz, is_box = box_on_a_floor()
    part = superpoints(xyz, SPACING, seeing(xyz, [np.full(len(xyz), FLOOR, np.int32)] * 4))
    assert np.array_equal(np.unique(part), np.arange(part.max() + 1))
    assert np.bincount(part).min() >= module.LEAST_POINTS
    owner = np.array([is_box[part == number].mean() for number in range(part.max() + 1)])[part]
    assert (np.where(is_box, owner, 1 - owner)).mean() > 0.97, "pieces lie on one side or on the other"


def test_superpoints_are_used_only_where_views_contradict_each_other() -> None:
    xyz, is_box = box_on_a_floor()
    true = np.where(is_box, BOX, FLOOR).astype(np.int32)
    random = np.random.default_rng(0)
    noisy = [np.where(random.random(len(true)) < 0.45, WALL, true).astype(np.int32) for _ in range(6)]
    assert trusted_superpoints(xyz, SPACING, seeing(xyz, noisy), CLASS_IDS, "pixels", masks_are_weak=False) is not None
    picture = true.copy()
    picture[(xyz[:, 0] < 0.7) & ~is_box] = WALL  # what lies in a plane with something else
    agreeing = seeing(xyz, [picture] * 6)
    assert trusted_superpoints(xyz, SPACING, agreeing, CLASS_IDS, "pixels", masks_are_weak=True) is None
    by_point, by_part = held_back_agreement(superpoints(xyz, SPACING, agreeing), agreeing, CLASS_IDS, "pixels")
    assert by_point == pytest.approx(1) and by_part < 0.95


def test_slightly_worse_superpoints_are_used_only_with_weak_masks() -> None:
    xyz, is_box = box_on_a_floor()
    picture = np.where(is_box, BOX, FLOOR).astype(np.int32)
    picture[np.argsort(np.linalg.norm(xyz - [0.5, 0.5, 0], axis=1))[:3]] = WALL  # small, and in the plane of the floor
    views = seeing(xyz, [picture] * 6)
    by_point, by_part = held_back_agreement(superpoints(xyz, SPACING, views), views, CLASS_IDS, "pixels")
    assert by_point - module.TOLERANCE < by_part < by_point
    for are_weak in (False, True):
        assert (
            trusted_superpoints(xyz, SPACING, views, CLASS_IDS, "pixels", masks_are_weak=are_weak) is not None
        ) == are_weak


def test_a_point_also_counts_the_votes_of_its_superpoint() -> None:
    own = sparse.csr_matrix(np.array([[1, 0], [2, 0], [0, 4]], np.float32))
    rest = RestOfSuperpoint(np.array([0, 0, 1])) @ own
    assert rest.toarray().tolist() == [[2, 0], [1, 0], [0, 0]]
    mean = RestOfSuperpoint(np.array([0, 0, 1]), mean=True) @ own
    assert mean.toarray().tolist() == [[1.5, 0], [1.5, 0], [0, 4]]


def test_a_picture_on_a_wall_is_not_outvoted_by_the_wall_where_views_agree() -> None:
    wall = sparse.csr_matrix(np.array([[0, 3]] * 2 + [[3, 0]] * 18, np.float32))  # two points of a picture
    part = np.zeros(20, np.int64)
    for in_all, shown in ((AGREEING - 0.01, [0, 0]), (AGREEING, [1, 1])):
        assert (wall + rest_of_superpoints(part, in_all) @ wall).toarray().argmax(1)[:2].tolist() == shown


def test_agreement_between_views_ignores_points_seen_by_only_one_view() -> None:
    """Two views that share no point and no piece, each of many: rounding leaves no votes of anybody else."""
    points, random = 20_000, np.random.default_rng(0)
    rows = np.arange(2 * points, dtype=np.int32).reshape(2, points)
    views = seeing(np.zeros((2 * points, 3), np.float32), [np.full(2 * points, FLOOR, np.int32)] * 2)
    seen = [
        ViewPoints(row, np.full(points, FLOOR, np.int32), *random.uniform(0.5, 9, (2, points)).astype(np.float32))
        for row in rows
    ]
    apart = ViewsOnCloud(views.views, views.point_of_pixel, seen)
    for kind in ("root", "resolution", "density"):
        assert held_back_agreement(np.arange(2 * points) // points, apart, CLASS_IDS, kind) == (0, 0), kind


def with_layers(views: ViewsOnCloud, shown: list[NDArray[np.int32]]) -> ViewsOnCloud:
    """The views with two detections of the box each, where ``shown`` says BOX."""
    layered = []
    for view, classes in zip(views.views, shown, strict=True):
        inside = np.array([classes.reshape(1, -1) == BOX] * 2)
        evidence = Evidence((Segment(1, BOX, True, 0.9), Segment(2, BOX, True, 0.3)), inside)
        layered.append(replace(view, layers=evidence.layers()))
    return ViewsOnCloud(layered, views.point_of_pixel, views.seen)


def test_masks_count_as_weak_where_views_disagree_on_small_classes() -> None:
    """Most of what is seen is floor, on which all agree; what the box is, they do not."""
    xyz, is_box = box_on_a_floor()
    true, random = np.where(is_box, BOX, FLOOR).astype(np.int32), np.random.default_rng(0)
    torn = [np.where(is_box, random.choice([BOX, WALL, FLOOR], len(true)), FLOOR).astype(np.int32) for _ in range(6)]
    good, weak = (agreement_of_views(seeing(xyz, shown), len(xyz), CLASS_IDS, "pixels") for shown in ([true] * 6, torn))
    assert good.by_class == good.in_all == 1 and not good.is_weak
    assert weak.by_class < WEAK < DOUBTED < weak.in_all and weak.is_weak


def test_the_lower_bound_of_agreement_holds_for_any_superpoints() -> None:
    """So they need not be found to know that they are not trusted, also where points are seen only once."""
    xyz, is_box = box_on_a_floor()
    random, count = np.random.default_rng(3), len(xyz)
    for noise in (0.02, 0.2, 0.4):
        shown = [np.where(random.random(count) < noise, WALL, np.where(is_box, BOX, FLOOR)) for _ in range(3)]
        views = seeing(xyz, [each.astype(np.int32) for each in shown])
        parts = [np.sort(random.choice(count, count // 2, replace=False)) for _ in shown]
        rows = [ViewPoints(row.astype(np.int32), one.segment[row], one.pixels[row], one.resolution[row])
                for row, one in zip(parts, views.seen, strict=True)]  # fmt: skip
        some = replace(views, seen=rows)
        found = agreement_of_views(some, count, CLASS_IDS, "pixels")
        for part in (superpoints(xyz, SPACING, some), random.integers(0, 9, count), np.arange(count)):
            by_point = held_back_agreement(part, some, CLASS_IDS, "pixels")[0]
            assert 0 < found.at_least <= by_point + 1e-9 and found.at_least < found.in_all


def test_with_weak_masks_a_rare_class_can_outvote_a_common_one() -> None:
    xyz, is_box = box_on_a_floor()
    views = seeing(xyz, [np.where(is_box, shown, FLOOR).astype(np.int32) for shown in (BOX, WALL, FLOOR, FLOOR)])
    asked = views, len(xyz), CLASS_IDS, "pixels"
    agreement = agreement_of_views(*asked)
    assert agreement.is_weak and agreement.in_all > DOUBTED
    balanced = class_balance(*asked, agreement).of(np.array([[2.5, 2.0, 1.0], [3.0, 2.0, 1.0], [4.0, 2.0, 1.0]]))
    assert balanced.argmax(1).tolist() == [1, 0, 0], "what most votes say stays"
    doubtful = replace(agreement, in_all=DOUBTED - 0.1)
    assert class_balance(*asked, doubtful).of(np.array([[3.0, 2.0, 1.0]])).argmax(1).tolist() == [1]
    votes = np.array([[3.0, 2.0, 1.0]])
    assert class_balance(*asked, replace(agreement, by_class=WEAK)).of(votes) is votes


def test_overlapping_detections_vote_as_views_of_their_own() -> None:
    xyz, is_box = box_on_a_floor()
    views = with_layers(seeing(xyz, [np.full(len(xyz), FLOOR, np.int32)] * 3), [np.where(is_box, BOX, FLOOR)] * 3)
    layers = views.layers()
    assert len(layers.views) == 6
    for view, seen in zip(layers.views, layers.seen, strict=True):
        assert view.mask.segments[0].class_id == BOX and view.frame in {each.name for each in views.views}
        assert np.array_equal(seen.segment > 0, is_box[seen.row])


def test_several_classes_of_one_detection_share_its_vote() -> None:
    """Everywhere that views vote on classes: points, segments and objects."""
    (views,) = [seeing(np.zeros((30, 3), np.float32), [np.full(30, FLOOR, np.int32)])]
    inside = np.ones((2, *views.views[0].mask.ids.shape), bool)
    segments = Segment(1, BOX, True, 0.6, share=0.75), Segment(2, WALL, False, 0.2, share=0.25)
    layered = replace(views.views[0], layers=Evidence(segments, inside).layers())
    layers = ViewsOnCloud([layered], views.point_of_pixel, views.seen).layers()
    columns = [CLASS_IDS.index(BOX), CLASS_IDS.index(WALL)]
    _, points = votes_of_views(layers, 30, np.array(CLASS_IDS), "views")
    np.testing.assert_allclose(points[:, columns], [[0.75, 0.25]] * 30)
    shown = [(seen, shown_classes(view, seen)) for view, seen in zip(layers.views, layers.seen, strict=True)]
    votes = vote_classes(shown, np.ones(30, np.int32), 1, CLASS_IDS, "views")
    np.testing.assert_allclose(votes[1, columns], [0.75, 0.25])
    maps = [np.full(view.mask.ids.shape, column, np.int16) for view, column in zip(layers.views, columns, strict=True)]
    asked = _votes(layers, maps, (30, len(CLASS_IDS)), "views", lambda *_: None).asked.toarray()
    np.testing.assert_allclose(asked[:, columns], [[0.75, 0.25]] * 30)


def test_agreement_by_class_weights_every_class_equally() -> None:
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
    found = agreement_of_views(views, 50, CLASS_IDS, "views")
    assert found.by_class == pytest.approx(expected)
    assert found.in_all == pytest.approx(np.mean(np.concatenate([*share.values()])))


def test_a_held_out_frame_is_held_out_with_its_detections() -> None:
    """Two frames that contradict each other, each confirmed by its own detections: nobody agrees."""
    shown = [np.full(30, each, np.int32) for each in (BOX, WALL)]
    views = with_layers(seeing(np.zeros((30, 3), np.float32), shown), [shown[0]] * 2)
    both = ViewsOnCloud([views.views[1], views.views[1].layer(0)], views.point_of_pixel[:2], views.seen[:2])
    seen = [view_points(view, rows) for view, rows in zip(both.views, both.point_of_pixel, strict=True)]
    both = replace(both, seen=seen)
    assert held_back_agreement(np.arange(30), both, CLASS_IDS, "views") == (0, 0)
    assert both.by_frame() == [[0, 1]]
