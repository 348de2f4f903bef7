"""Trials on the labelled points: a sink that near views draw in a countertop."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

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
    (told,) = caplog.messages
    assert "trial kept: sink in place of countertop" in told and "near 0" in told


def test_a_part_of_an_object_joins_it() -> None:
    given = countertop()
    known = IN_SINK & (PLACES[:, 0] < -0.08)  # a strip of it
    owner, class_id = np.where(known, 1, 0).astype(np.int32), np.where(known, SINK, TOP).astype(np.int32)
    mask = ObjectMask("near 0", next(one for one in NEAR[0].view.mask.segments if one.class_id == SINK))
    start = Labelled(replace(given.cloud, class_id=class_id), owner, [SceneObject(1, (mask,), SINK)])
    found = mend(start, SHOWN)
    assert (found.owner[IN_SINK] == 1).all() and len(found.things) == 1
    assert sorted(one.frame for one in found.things[0].masks) == [one.view.name for one in NEAR]


def test_views_that_were_held_back_refuse_what_one_drew_otherwise(caplog: pytest.LogCaptureFixture) -> None:
    """Each of three near views draws its sink at another place."""
    views = [flat_view(f"near {k}", 1.0, 0.0, [(0.16 * k - 0.16, 0.0)]).view for k in range(3)]
    with caplog.at_level(logging.INFO, "plgs.lift"):
        found = mend(countertop(), views)
    assert not found.things and (found.cloud.class_id == TOP).all()
    assert caplog.messages and all("refused" in told for told in caplog.messages)


def test_two_near_views_are_too_few() -> None:
    assert not mend(countertop(), [one.view for one in (*FAR, *NEAR[:2])]).things


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
