"""Cancelling: by the file, by the parent's end, and against a main thread that does not listen."""

import errno
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest

from engine.errors import Cancelled
from engine.job import EventWriter, ExitCode, StopSignal, Watchdog
from tests.waiting import PATIENCE_S


class Ended:
    """Stands for the end of the process."""

    def __init__(self) -> None:
        self.code: int | None = None
        self.when = threading.Event()

    def __call__(self, code: int) -> None:
        self.code = code
        self.when.set()


@pytest.fixture
def events(tmp_path: Path) -> Iterator[EventWriter]:
    writer = EventWriter(tmp_path / "events.jsonl")
    writer.hello(threads=1, resumed=False)
    yield writer
    writer.close()


def test_a_full_disk_does_not_keep_a_hanging_engine_alive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events = EventWriter(tmp_path / "events.jsonl")
    monkeypatch.setattr(events, "done", Mock(side_effect=OSError(28, "No space left on device")))
    ended, stop = Ended(), StopSignal(tmp_path / "cancel")
    with Watchdog(stop, events, end_process=ended, grace_s=0.1):
        stop.ask("enough")
        assert ended.when.wait(PATIENCE_S)
    assert ended.code == ExitCode.CANCELLED
    events.close()


def test_the_watchdog_spares_an_engine_that_stops_by_itself(tmp_path: Path, events: EventWriter) -> None:
    ended, stop = Ended(), StopSignal(tmp_path / "cancel")
    with Watchdog(stop, events, end_process=ended, grace_s=PATIENCE_S):
        (tmp_path / "cancel").touch()
        with pytest.raises(Cancelled):
            stop.check()
    for thread in threading.enumerate():
        if thread.name == "plgs-watchdog":
            thread.join(PATIENCE_S)
            assert not thread.is_alive()
    assert not ended.when.is_set()


def test_the_watchdog_keeps_the_exit_code_of_a_signal(tmp_path: Path, events: EventWriter) -> None:
    ended, stop = Ended(), StopSignal(tmp_path / "cancel")
    with Watchdog(stop, events, end_process=ended, grace_s=0.1):
        stop.ask("Ctrl-C", ExitCode.INTERRUPTED)
        assert ended.when.wait(PATIENCE_S)
    assert ended.code == 130


@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE])
def test_a_slow_disk_does_not_make_the_watchdog_end_the_engine(
    tmp_path: Path, events: EventWriter, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    looked = threading.Event()

    def no_answer(path: Path) -> bool:
        looked.set()
        raise OSError(number, os.strerror(number))

    ended, stop = Ended(), StopSignal(tmp_path / "cancel")
    with monkeypatch.context() as patch, Watchdog(stop, events, end_process=ended):
        patch.setattr(Path, "exists", no_answer)
        stop.check()
        looked.clear()
        assert looked.wait(PATIENCE_S)
        patch.undo()
        (tmp_path / "cancel").touch()
        assert ended.when.wait(PATIENCE_S)
