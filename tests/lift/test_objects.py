"""Which pieces of the objects stay."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from engine.errors import Cancelled
from engine.instances.agreement import ViewPoints
from engine.instances.records import ObjectMask, SceneObject
from engine.job import EventWriter, StopSignal, last_run, progress
from engine.job.progress import StageReporter
from engine.lift.objects import without_fragments
from engine.lift.preparation import ViewsToLift, find
from engine.lift.run import STAGES
from engine.scene import Segment
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
def test_objects_with_too_few_masks_are_removed(
    views: int, of_first: int, of_second: int, origin: list[int], owners: list[int]
) -> None:
    owner = np.array([1, 1, 2, 2], np.int32)
    pieces = [piece(origin[0], of_first), piece(origin[1], of_second)]
    found, kept = without_fragments(owner, pieces, views_of(4, views))
    assert found[[0, 2]].tolist() == owners
    assert [one.id for one in kept] == list(range(1, max(owners) + 1))


def test_an_object_seen_by_two_views_needs_only_two_masks() -> None:
    owner = np.array([1, 1, 2, 2], np.int32)
    views = [*views_of(2, 6), *views_of(4, 2)]  # two views see the second object
    found, _ = without_fragments(owner, [piece(1, 6), piece(2, 2)], views)
    assert found.tolist() == owner.tolist()
    assert without_fragments(owner, [piece(1, 6), piece(1, 2)], views)[0].tolist() == [1, 1, 0, 0]


PARTS = (0.0, 0.1, 0.15, 0.2, 0.3, 0.4, 0.85, 0.92, 0.94, 0.95, 1.0)
"""Shares of the matching at which another of its parts begins."""


def match(folder: Path, stop: StopSignal, scratch: Path | None = None) -> list[float]:
    """Match the masks of a tiny room, and return the shares that were told, also where it was stopped."""
    views, classes = views_of_a_room(folder / "scene", size=(32, 24))
    events = EventWriter(folder / "events.jsonl")
    events.hello(threads=1, resumed=False)
    try:
        find(ViewsToLift(views[1:], classes, TINY, 0, views[:1], scratch), StageReporter(events, stop, STAGES))
    except Cancelled:
        assert stop.reason
    finally:
        events.close()
    told = [event.data for event in last_run(folder / "events.jsonl") if event.data.get("stage") == "match"]
    return [each["step"] / each["steps"] for each in told]


def test_object_matching_reports_its_progress(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "REPORT_EVERY_S", 0.0)
    shares = match(tmp_path, StopSignal())
    assert shares == sorted(shares)
    for begin, end in pairwise(PARTS):
        assert any(begin <= each < end for each in shares), f"nothing is told from {begin} to {end}"


@pytest.mark.parametrize("begin", PARTS[:-1:3])
def test_matching_can_be_stopped_at_every_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begin: float) -> None:
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
