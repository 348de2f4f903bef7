"""Which pieces of the objects stay."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from engine.errors import Cancelled
from engine.instances.agreement import ViewPoints, ViewsOnCloud
from engine.instances.records import ObjectMask, SceneObject
from engine.job import EventWriter, StopSignal, last_run
from engine.lift.objects import LEAST_ALONE, maps_of_points, scraps, without_fragments
from engine.lift.preparation import find
from engine.lift.run import STAGES
from engine.scene import Camera, Category, ClassTable, PanopticMask, Segment, View
from engine.semantics.point_cloud import SemanticPointCloud
from engine.train import progress
from engine.train.progress import StageReporter
from tests.train.tiny_lift import TINY
from tests.train.tiny_lift import views_of as views_of_a_room


def views_of(points: int, count: int) -> list[ViewPoints]:
    """Views that see all points."""
    ones = np.ones(points, np.float32)
    return [ViewPoints(np.arange(points, dtype=np.int32), ones.astype(np.int32), ones, ones) for _ in range(count)]


def piece(source: int, count: int) -> SceneObject:
    """A piece of the object ``source`` with that many masks."""
    return SceneObject(source, tuple(ObjectMask(f"{number:04}", Segment(1, 5, True)) for number in range(count)))


@pytest.mark.parametrize(
    ("views", "of_first", "of_second", "origin", "owners"),
    [
        pytest.param(8, 6, 2, [1, 1], [1, 0], id="the edge of two masks goes"),
        pytest.param(8, 6, 3, [1, 1], [1, 2], id="a piece with three masks stays"),
        pytest.param(3, 2, 2, [1, 1], [1, 2], id="three views give no more than two"),
        pytest.param(8, 0, 4, [1, 2], [0, 1], id="without masks there is no object"),
    ],
)
def test_fragments_of_a_few_masks_go(
    views: int, of_first: int, of_second: int, origin: list[int], owners: list[int]
) -> None:
    owner = np.array([1, 1, 2, 2], np.int32)
    pieces = [piece(origin[0], of_first), piece(origin[1], of_second)]
    found, kept = without_fragments(owner, pieces, views_of(4, views))
    assert found[[0, 2]].tolist() == owners
    assert [one.id for one in kept] == list(range(1, max(owners) + 1))


def test_an_object_in_one_piece_needs_no_more_masks_than_the_views_that_see_it() -> None:
    owner = np.array([1, 1, 2, 2], np.int32)
    views = [*views_of(2, 6), *views_of(4, 2)]  # two views see the second object
    found, _ = without_fragments(owner, [piece(1, 6), piece(2, 2)], views)
    assert found.tolist() == owner.tolist()
    assert without_fragments(owner, [piece(1, 6), piece(1, 2)], views)[0].tolist() == [1, 1, 0, 0]


def test_few_points_of_a_thing_that_no_object_owns_are_scraps() -> None:
    """As few points are none if they are of a wall or of an object; and two groups are not one."""
    classes = ClassTable((Category(1, "wall", False, (0, 0, 0)), Category(2, "chair", True, (0, 0, 0))))
    few, many = LEAST_ALONE - 1, LEAST_ALONE
    groups = [(1, 0, few), (2, 7, few), (2, 0, few), (2, 0, few), (2, 0, many)]  # class, owner, points
    class_id, owner, count = np.array(groups, np.int32).T
    along = np.concatenate([0.1 * np.arange(each) for each in count])
    group = np.repeat(np.arange(len(groups)), count)
    xyz = np.stack([along, group, np.zeros(len(group))], axis=1).astype(np.float32)
    colour, share, votes = np.zeros((len(xyz), 3), np.uint8), np.ones(len(xyz), np.float32), np.ones((len(xyz), 2))
    cloud = SemanticPointCloud(xyz, colour, class_id[group], share, votes.astype(np.float32), (1, 2), spacing=0.03)
    found = scraps(cloud, owner[group], classes)
    assert found.tolist() == np.isin(group, [2, 3]).tolist()


def test_a_few_points_do_not_take_a_segment_whose_other_points_are_scraps() -> None:
    """A segment of four points of one object, three of another and three scraps."""
    wide, nothing = np.zeros((1, 10), np.float32), np.zeros((1, 10, 3), np.uint8)
    mask = PanopticMask(np.ones((1, 10), np.int32), (Segment(1, 2, True),))
    view = View("0000", Camera(10, 1, 10.0, 10.0, 5.0, 0.5, np.eye(4)), nothing, wide, mask)
    owner = np.array([1] * 4 + [2] * 3 + [0] * 3, np.int32)
    class_id, before = np.array([3] * 4 + [2] * 3 + [0] * 3, np.int32), np.array([0] * 7 + [2] * 3, np.int32)
    xyz, share = np.zeros((10, 3), np.float32), np.ones(10, np.float32)
    cloud = SemanticPointCloud(xyz, nothing[0], class_id, share, np.ones((10, 2), np.float32), (2, 3), spacing=0.03)
    seeing = ViewsOnCloud([view], [np.arange(10, dtype=np.int32)[None]], [])
    things = [SceneObject(1, (), 3), SceneObject(2, (), 2)]
    (found,) = maps_of_points(seeing, cloud, things, owner, before)
    assert found.tolist() == [[2] * 4 + [3] * 3 + [-1] * 3]


PARTS = (0.0, 0.1, 0.15, 0.2, 0.3, 0.4, 0.85, 0.92, 0.94, 0.95, 1.0)
"""Shares of the matching at which another of its parts begins."""


def match(folder: Path, stop: StopSignal, scratch: Path | None = None) -> list[float]:
    """Match the masks of a tiny room, and return the shares that were told, also where it was stopped."""
    views, classes = views_of_a_room(folder / "scene", size=(32, 24))
    events = EventWriter(folder / "events.jsonl")
    events.hello(threads=1, resumed=False)
    try:
        find(views[1:], classes, TINY, StageReporter(events, stop, STAGES), scratch, views[:1])
    except Cancelled:
        assert stop.reason
    finally:
        events.close()
    told = [event.data for event in last_run(folder / "events.jsonl") if event.data.get("stage") == "match"]
    return [each["step"] / each["steps"] for each in told]


def test_all_parts_of_matching_tell_how_far_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "REPORT_EVERY_S", 0.0)
    shares = match(tmp_path, StopSignal())
    assert shares == sorted(shares)
    for begin, end in pairwise(PARTS):
        assert any(begin <= each < end for each in shares), f"nothing is told from {begin} to {end}"


@pytest.mark.parametrize("begin", PARTS[:-1])
def test_matching_is_stopped_in_each_of_its_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begin: float
) -> None:
    """And leaves no file of its own."""
    monkeypatch.setattr(progress, "REPORT_EVERY_S", 0.0)
    (tmp_path / "scratch").mkdir()
    tell = EventWriter.progress

    def cancelling(events: EventWriter, stage: str, step: int, steps: int, **more: float | None) -> None:
        tell(events, stage, step, steps, **more)
        if stage == "match" and step >= begin * steps:
            (tmp_path / "cancel").touch()

    monkeypatch.setattr(EventWriter, "progress", cancelling)
    shares = match(tmp_path, StopSignal(tmp_path / "cancel"), tmp_path / "scratch")
    assert shares[-1] >= begin and all(each < begin for each in shares[:-1])
    assert not list((tmp_path / "scratch").iterdir())
