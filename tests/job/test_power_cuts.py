"""Unsynced writes dropped and reordered: the old state or the new one is whole, and the next run goes on."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from engine.job import EventReader, EventWriter, JobError, LiftFolder, LiftRequest, write_atomically
from engine.job.recent import remember_lift, remembered_lifts
from tests.job.lost_writes import Recorder, after_power_cuts
from tests.job.test_faults import bake, finish, lay, names_in, save, saved

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="descriptors are looked up as Linux has them")
Cuts = Callable[[Callable[[Path], object], Callable[[Path], object]], Iterator[Path]]


@pytest.fixture(params=[5, pytest.param(200, marks=pytest.mark.slow)], ids=["few", "many"])
def cuts(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cuts:
    """Records ``work`` in a prepared folder, and hands over what power cuts may leave of it."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # of what is not recorded

    def cuts(prepare: Callable[[Path], object], work: Callable[[Path], object]) -> Iterator[Path]:
        folder = tmp_path / "recorded"
        folder.mkdir()
        prepare(folder)
        recorder = Recorder(folder, monkeypatch)
        with recorder.recording():
            work(folder)
        assert len(recorder.changes) > 2
        yield from after_power_cuts(recorder, tmp_path / "left", request.param)

    return cuts


def test_what_is_not_synced_is_lost(tmp_path: Path, cuts: Cuts) -> None:
    """The harness itself: a file that is replaced without fsync may be empty."""

    def replace(folder: Path) -> None:
        (folder / "part").write_text("new")
        os.replace(folder / "part", folder / "file")

    left = cuts(lambda folder: (folder / "file").write_text("old"), replace)
    assert {"old", "new", ""} <= {(folder / "file").read_text() for folder in left}


@pytest.mark.parametrize("content", ["new", lambda part: part.write_text("new")], ids=["text", "function"])
def test_a_file(cuts: Cuts, content: str | Callable[[Path], object]) -> None:
    found = []
    for folder in cuts(
        lambda folder: (folder / "file").write_text("old"), lambda folder: write_atomically(folder / "file", content)
    ):
        found.append((folder / "file").read_text())
        write_atomically(folder / "file", "newer")
    assert {*found} == {"old", "new"} and found[-1] == "new"


def test_a_checkpoint(cuts: Cuts) -> None:
    def twice(folder: Path) -> None:
        save(folder, 2)
        save(folder, 3)

    found = []
    for folder in cuts(lambda folder: save(folder, 1), twice):
        found.append(saved(folder))
        save(folder, 4)
        assert saved(folder) == 4
    assert {*found} == {1, 2, 3} and found[-1] == 3


def test_a_first_checkpoint(cuts: Cuts) -> None:
    for folder in cuts(lambda folder: None, lambda folder: save(folder, 1)):
        try:
            assert saved(folder) == 1
        except AssertionError:
            save(folder, 1)
            assert saved(folder) == 1


def test_a_manifest(cuts: Cuts) -> None:
    def write(result: Path) -> None:
        for name in ("a", "b"):
            write_atomically(result / name, f"content of {name}")
        finish(result)

    for result in cuts(lambda result: None, write):
        if (result / "manifest.json").exists():
            assert names_in(result) == {"a", "b"}


def test_baking(cuts: Cuts) -> None:
    def prepare(folder: Path) -> None:
        (folder / "result").mkdir()
        lay(folder / "result", "a")
        finish(folder / "result")

    found = set()
    for folder in cuts(prepare, lambda folder: bake(folder, ("x", "y"))):
        found.add(frozenset(names_in(folder / "result")))
        bake(folder, ("x", "y"))
        assert names_in(folder / "result") == {"a", "x", "y"}
    assert found == {frozenset("a"), frozenset("ax"), frozenset("axy")}


def test_events(cuts: Cuts) -> None:
    """They are not synced, for there are many: some may be lost, but what is left is read and gone on with."""

    def tell(folder: Path) -> None:
        writer = EventWriter(folder / "events.jsonl")
        for step in range(3):
            writer.progress("train", step, 3)

    for folder in cuts(lambda folder: EventWriter(folder / "events.jsonl").hello(threads=1, resumed=False), tell):
        EventWriter(folder / "events.jsonl").warning("goes on")
        events = EventReader(folder / "events.jsonl").poll()
        assert events[-1].kind == "warning"
        assert all(one.seq < other.seq for one, other in zip(events, events[1:], strict=False))


def test_the_list_of_lifts(cuts: Cuts) -> None:
    for cache in cuts(lambda cache: remember_lift(Path("/a"), cache), lambda cache: remember_lift(Path("/b"), cache)):
        assert remembered_lifts(cache) in (["/a"], ["/b", "/a"])


def test_a_new_folder(cuts: Cuts) -> None:
    request = LiftRequest(scene=Path("/scene"))
    for folder in cuts(lambda folder: None, lambda folder: LiftFolder.create(folder / "lift", request)):
        try:
            assert LiftFolder.open(folder / "lift").request == request
        except JobError as error:
            assert "request.json" in error.what or "is no folder" in error.what
            assert LiftFolder.create(folder / "lift", request).request == request
