"""Trials on the labelled points: a sink that near views draw in a countertop."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from engine.instances.agreement import ViewsOnCloud
from engine.instances.records import ObjectMask, SceneObject
from engine.lift.objects import point_of_pixels
from engine.lift.repairs import Labelled, repaired
from engine.scene import View
from engine.semantics.point_cloud import SemanticPointCloud
from tests.metrics.test_unshown import CLASSES, FAR, NEAR, ONE, SINK, TOP, flat_view

SPACING = 0.03
AXIS = np.arange(-0.5, 0.5, SPACING)
PLACES = np.stack([*np.meshgrid(AXIS, AXIS), np.zeros((len(AXIS), len(AXIS)))], axis=-1).reshape(-1, 3)
IN_SINK = (np.abs(PLACES[:, :2]) <= 0.13).all(axis=1)
"""Points a little within the sink's outline."""
SHOWN = [one.view for one in (*FAR, *NEAR)]


def countertop(class_id: int = TOP) -> Labelled:
    """A countertop that shows no sink; no object owns it."""
    count = len(PLACES)
    colours, votes = np.zeros((count, 3), np.uint8), np.zeros((count, 2), np.float32)
    classes, share = np.full(count, class_id, np.int32), np.ones(count, np.float32)
    cloud = SemanticPointCloud(PLACES.astype(np.float32), colours, classes, share, votes, (TOP, SINK), SPACING)
    return Labelled(cloud, np.zeros(count, np.int32), [])


def mend(given: Labelled, views: Sequence[View]) -> Labelled:
    seeing = ViewsOnCloud.of(views, point_of_pixels(views, given.cloud, None))
    return repaired(given, seeing, CLASSES, reach=0.15, progress=lambda *_: None)


def test_what_near_views_show_becomes_an_object_of_its_own(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "plgs.lift"):
        found = mend(countertop(), SHOWN)
    assert (found.cloud.class_id[IN_SINK] == SINK).all() and (found.owner[IN_SINK] == 1).all()
    assert 0.05 < np.mean(found.cloud.class_id == SINK) < 0.15  # a sink of 0.3 m in a countertop of 1 m
    (sink,) = found.things
    assert sink.class_id == SINK and {mask.frame for mask in sink.masks} == {one.view.name for one in NEAR}
    assert not found.refused
    told, of_top = caplog.messages
    assert "trial kept: sink in place of countertop" in told and "near 0" in told and "IoU" not in told
    assert "trial refused: countertop in place of nothing" in of_top and "no points" in of_top


def sinks_of(views: Sequence[View], number: int = 2) -> tuple[ObjectMask, ...]:
    """The segments of this number, those of a sink from 2, as masks of an object."""
    return tuple(
        ObjectMask(one.name, segment) for one in views for segment in one.mask.segments if segment.id == number
    )


def with_object(
    own: NDArray[np.bool_], masks: tuple[ObjectMask, ...], class_id: int = SINK, is_owned: bool = True
) -> Labelled:
    """A countertop with an object of the points ``own``, or points of its class without one."""
    given = countertop()
    cloud = replace(given.cloud, class_id=np.where(own, class_id, given.cloud.class_id).astype(np.int32))
    things = [SceneObject(1, masks, class_id)] if is_owned else []
    return Labelled(cloud, (own & is_owned).astype(np.int32), things)


STRIP = IN_SINK & (PLACES[:, 0] < -0.08)
CLOSE = [one.view for one in NEAR]


def test_a_part_of_an_object_joins_it() -> None:
    found = mend(with_object(STRIP, sinks_of(CLOSE[:1])), SHOWN)
    assert (found.owner[IN_SINK] == 1).all() and len(found.things) == 1
    assert sorted(one.frame for one in found.things[0].masks) == [one.name for one in CLOSE]


def test_a_neighbour_that_views_tell_apart_becomes_another_object() -> None:
    """Two sinks, 10 cm from each other; the first has an object."""
    views = [flat_view(f"near {k}", 1.0 + 0.02 * k, 0.02 * k, [(-0.2, 0.0), (0.2, 0.0)]).view for k in range(4)]
    first, second = ((np.abs(PLACES[:, :2] - [x, 0.0]) <= 0.13).all(axis=1) for x in (-0.2, 0.2))
    found = mend(with_object(first, sinks_of(views)), views)
    assert (found.owner[first] == 1).all() and (found.owner[second] == 2).all()
    assert found.things[0].masks == sinks_of(views) and found.things[1].masks == sinks_of(views, 3)


def test_points_of_its_class_that_nobody_owns_are_of_a_new_object() -> None:
    found = mend(with_object(STRIP, (), is_owned=False), SHOWN)
    assert (found.owner[IN_SINK] == 1).all() and len(found.things) == 1


def denying(count: int, distance: float, x: float = 0.0) -> list[View]:
    """Views that show countertop alone."""
    return [flat_view(f"denying {k}", distance, x + 0.01 * k, ONE, draws=False).view for k in range(count)]


BESIDE = [flat_view(f"beside {k}", 1.02, 0.02 * k, [*ONE, (0.28, 0.0)]).view for k in range(3)]
"""They draw another sink, which covers 2 cm of the first."""
LEFT = [flat_view(f"left {k}", 2.02, 0.02 * k, [(-0.2, 0.0)]).view for k in range(4)]
"""They draw the sink farther to the left."""
ACROSS = (np.abs(PLACES[:, :2] - [-0.135, 0.0]) <= [0.1, 0.13]).all(axis=1)
"""Half of it is in the sink, all of it in what these draw."""
EVERYWHERE = np.ones(len(PLACES), bool)
ELSEWHERE = np.abs(PLACES[:, 0] - 0.45) < 0.02
GROUPS = [
    replace(
        one, mask=replace(one.mask, segments=tuple(replace(s, is_group=s.class_id == SINK) for s in one.mask.segments))
    )
    for one in CLOSE
]


@pytest.mark.parametrize(
    ("given", "views", "refused"),
    [
        pytest.param(countertop(), [*CLOSE, *denying(8, 2.02)], None, id="near views outweigh farther ones"),
        pytest.param(countertop(), [*CLOSE, *denying(18, 2.02)], "it leads by 14.5%", id="a small lead is too little"),
        pytest.param(countertop(), [*CLOSE, *denying(5, 1.0, 0.62)], None, id="views that see a third have no say"),
        pytest.param(countertop(), [CLOSE[0], *BESIDE], None, id="another sink beside it is none of it"),
        pytest.param(
            with_object(EVERYWHERE, sinks_of(SHOWN, 1), TOP), SHOWN, "would fall by 0.033", id="an object falls by 3 %"
        ),
        pytest.param(
            with_object(ACROSS, sinks_of(LEFT)),
            [*CLOSE, *LEFT],
            "would fall by 0.127, more than 0.02",
            id="the object that it is a part of falls",
        ),
        pytest.param(
            with_object(ELSEWHERE, sinks_of(CLOSE)), SHOWN, "another object's", id="another object has all the masks"
        ),
        pytest.param(countertop(), GROUPS, "", id="groups may be several objects"),
    ],
)
def test_a_sink_is_kept_or_nothing_changes(given: Labelled, views: Sequence[View], refused: str | None) -> None:
    found = mend(given, views)
    if refused is None:
        outside = (np.abs(PLACES[:, :2]) > 0.17).any(axis=1)
        assert (found.owner[IN_SINK] == 1).all() and not found.owner[outside].any()
    else:
        told = [one.finding.refused for one in found.refused]
        assert refused in ", ".join(told) if refused else not told, told
        assert (found.owner == given.owner).all() and (found.cloud.class_id == given.cloud.class_id).all()


def test_views_that_were_held_back_refuse_what_one_drew_otherwise(caplog: pytest.LogCaptureFixture) -> None:
    """Each of three near views draws its sink at another place."""
    views = [flat_view(f"near {k}", 1.0, 0.0, [(0.16 * k - 0.16, 0.0)]).view for k in range(3)]
    with caplog.at_level(logging.INFO, "plgs.lift"):
        found = mend(countertop(), views)
    assert not found.things and (found.cloud.class_id == TOP).all()
    (sink,) = found.refused
    assert sink.finding.refused == "only 1 near view sees enough of what the others draw (3 are asked)"
    assert caplog.messages and all("refused" in told for told in caplog.messages)


def test_two_near_views_are_too_few() -> None:
    found = mend(countertop(), [one.view for one in (*FAR, *NEAR[:2])])
    (sink,) = found.refused
    told = "only 2 views see enough of what could be drawn (3 are asked), only 2 near views see enough of what"
    assert not found.things and sink.finding.refused.startswith(told)
    assert 8 <= len(sink.places) <= 64 and np.abs(sink.places).max() < 0.17


def test_no_object_falls() -> None:
    """All of the sink's points are those of another object, which has masks there."""
    given = countertop()
    masks = tuple(ObjectMask(one.view.name, one.view.mask.segments[0]) for one in FAR)
    owner = np.where(IN_SINK, 1, 0).astype(np.int32)
    start = replace(given, owner=owner, things=[SceneObject(1, masks, TOP)])
    found = mend(start, SHOWN)
    assert (found.owner == owner).all() and (found.cloud.class_id == TOP).all()


def test_nothing_is_tried_where_the_points_show_what_the_masks_do(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "plgs.lift"):
        views = [flat_view(f"near {k}", 1.0, 0.0, ONE, draws=False).view for k in range(4)]
        assert not mend(countertop(), views).things
    assert not caplog.messages
