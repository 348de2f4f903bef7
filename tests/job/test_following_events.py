"""What a follower makes of the events that it reads: many at once, bad ones, and none for a moment."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

import pytest

from engine.job import EventWriter, LiftFolder, LiftState
from engine.job.events import MOST_BYTES, TAIL_BYTES
from engine.job.follower import TaskFollower
from engine.job.lock import FileLock
from engine.job.task import TaskState
from tests.job.bytes_read import bytes_read
from tests.job.following import Start, follow, watch
from tests.job.lift_folders import new_lift

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


def test_a_poll_is_quick_however_much_was_reported(folder: LiftFolder) -> None:
    events = EventWriter(folder.events_path)
    events.hello(threads=1, resumed=False)
    events.stage("train", 1, 1, "Training")
    events.close()
    line = '{"seq": 3, "time": 1.5, "event": "%s", "stage": "train", "step": %d, "steps": 90000, "message": ""}\n'
    with folder.events_path.open("a") as file:
        file.writelines(line % ("warning" if step % 25 == 0 else "progress", step) for step in range(60000))
    with folder.lock():
        watcher = watch(folder)
        while watcher.progress.step < 59999:
            before, step = bytes_read(), watcher.progress.step
            assert watcher.poll()
            assert bytes_read() - before < 2 * MOST_BYTES
            assert watcher.is_running and watcher.progress.step > step
        before = bytes_read()
        folder.state()
        assert bytes_read() - before < 3 * TAIL_BYTES
    watcher.poll()
    assert not watcher.is_running and watcher.progress.label == "Training"


@pytest.mark.parametrize(
    ("said", "state"),
    [("finished", TaskState.FINISHED), ("cancelled", TaskState.CANCELLED), (None, TaskState.FAILED)],
)
def test_the_end_of_a_bake_is_not_the_state_of_the_lift(
    folder: LiftFolder, start: Start, said: str | None, state: TaskState
) -> None:
    follow(start("short"))
    events = EventWriter(folder.events_path)
    events.hello(threads=1, resumed=False, task="bake")
    events.stage("bake", 1, 1, "Baking")
    if said is not None:
        events.done(said)
    events.close()
    watcher = watch(folder)
    follow(watcher)
    assert watcher.kind == "bake" and watcher.state is state
    assert folder.state() is LiftState.FINISHED


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "1" + "0" * 400, '"x"', "null"])
def test_invalid_numbers_are_skipped(folder: LiftFolder, number: str) -> None:
    line = f'{{"seq": 1, "time": 0, "event": "progress", "step": {number}, "steps": 9, "loss": 1, "eta_s": {number}}}'
    folder.events_path.write_text(line + "\n")
    watcher = watch(folder)
    watcher.poll()
    status = watcher.progress
    assert (status.step, status.steps, status.loss, status.eta_s) == (0, 9, 1.0, None)


@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE])
def test_a_lift_survives_a_disk_that_does_not_answer_for_a_moment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    folder, now = new_lift(tmp_path), [0.0]
    writer = EventWriter(folder.events_path)
    writer.hello(threads=1, resumed=False)
    watcher = TaskFollower(folder.place, lift=folder, clock=lambda: now[0])

    def no_answer(*_: object, **__: object) -> object:
        raise OSError(number, os.strerror(number))

    with FileLock(folder.events_path):
        watcher.poll()
        writer.warning("goes on")
        for module in ("engine.job.lock", "engine.job.events"):
            with monkeypatch.context() as patch:
                patch.setattr(f"{module}.open_plain", no_answer)
                now[0] += 4.0
                assert not watcher.poll() and watcher.is_running
        now[0] += 100.0
        assert watcher.poll() and watcher.progress.warnings == ["goes on"] and watcher.is_running
        monkeypatch.setattr("engine.job.events.open_plain", no_answer)
        assert not watcher.poll()
        now[0] += 100.0
        assert watcher.poll() and watcher.state is TaskState.FAILED
        assert "can no longer be followed" in str(watcher.error)
