"""Two processes: whatever happens to one, the other does the right thing."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from engine.errors import ErrorCode
from engine.job import EventReader, LiftFolder, LiftState
from engine.job.follower import TaskFollower
from engine.job.process import EngineProcess
from engine.job.task import TaskPlace, TaskState
from tests.job.following import Start, follow, step_reached

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


def test_it_follows_to_the_end(folder: LiftFolder, start: Start) -> None:
    follower = start("short")
    follow(follower)
    assert follower.error is None
    assert follower.state is TaskState.FINISHED and folder.state() is LiftState.FINISHED
    assert follower.progress.label == "Training" and follower.progress.step == 1
    log = folder.log_path.read_text()
    assert "python talks\n" in log and "native code talks\n" in log


def test_cancel_stops_it_and_resume_continues_it(folder: LiftFolder, start: Start) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 3))
    follower.cancel()
    follow(follower)
    assert follower.state is TaskState.CANCELLED and folder.state() is LiftState.CANCELLED
    checkpoint = folder.checkpoints.latest()
    assert checkpoint is not None
    again = start("short", resume=True)
    follow(again)
    assert again.state is TaskState.FINISHED and not folder.cancel_path.exists()
    steps = [event.data["step"] for event in EventReader(folder.events_path).poll() if event.kind == "progress"]
    assert steps == [*range(1, 11), 1]  # no step was done twice; the last one is the tiny lift's own


class DeafEngine:
    """An engine that runs until it is killed."""

    def __init__(self) -> None:
        self.killed = False

    def exit_code(self) -> int | None:
        return -9 if self.killed else None

    def output_tail(self) -> str:
        return ""

    def kill(self) -> None:
        self.killed = True

    def close(self) -> None:
        """Nothing to let go of."""


@pytest.mark.parametrize("asked_by", ["us", "somebody else"])
def test_a_hanging_engine_gets_between_half_a_second_and_one_second(folder: LiftFolder, asked_by: str) -> None:
    now, engine = [100.0], DeafEngine()
    follower = TaskFollower(folder.place, engine, lift=folder, clock=lambda: now[0])
    follower.poll()
    now[0] = 200.0
    if asked_by == "us":
        follower.cancel()
    else:
        folder.cancel_path.touch()
    for after_s, is_killed in ((0.0, False), (0.5, False), (0.9, True)):
        now[0] = 200.0 + after_s
        follower.poll()
        assert engine.killed is is_killed
    follower.poll()
    assert follower.state is TaskState.CANCELLED


@pytest.mark.parametrize("behaviour", ["deaf", "holds the lock"])
def test_cancel_ends_a_hanging_engine(folder: LiftFolder, start: Start, behaviour: str) -> None:
    follower = start(behaviour)
    follow(follower, step_reached(follower, 5))
    folder.cancel_path.touch()  # somebody else asks
    follow(follower)
    assert follower.state is TaskState.CANCELLED
    assert folder.checkpoints.latest() is not None and not folder.is_running


def test_cancel_needs_no_room_on_the_disk(folder: LiftFolder, start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    follower = start("patient")
    follow(follower, step_reached(follower, 2))
    monkeypatch.setattr(TaskPlace, "ask_to_cancel", full)
    follower.cancel()
    follow(follower)
    assert follower.state is TaskState.CANCELLED and not folder.cancel_path.exists()


def test_cancel_follows_no_link(folder: LiftFolder, start: Start, tmp_path: Path) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 2))
    folder.cancel_path.symlink_to(tmp_path / "elsewhere")
    follower.cancel()
    follow(follower)
    assert follower.state is TaskState.CANCELLED and not (tmp_path / "elsewhere").exists()


def test_a_killed_engine_is_reported_and_can_be_resumed(folder: LiftFolder, start: Start) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 3))
    follower.kill()
    follow(follower)
    assert follower.state is TaskState.FAILED
    assert "signal 9 (often: out of memory)" in str(follower.error)
    assert folder.state() is LiftState.INTERRUPTED
    again = start("short", resume=True)
    follow(again)
    assert again.state is TaskState.FINISHED


@pytest.mark.parametrize(
    ("behaviour", "code", "told", "logged"),
    [
        ("bad input", ErrorCode.BAD_INPUT, "is too dark: {scene}. Switch the light on.", "python talks"),
        ("broken", ErrorCode.INTERNAL, "ZeroDivisionError: no such luck", "Traceback"),
        ("memory", ErrorCode.INTERNAL, "memory ran out", "MemoryError"),
        ("memory of torch", ErrorCode.INTERNAL, "memory ran out", "DefaultCPUAllocator"),
        ("segfault", ErrorCode.KILLED, "signal 11: ", "Segmentation fault"),
        ("exits", ErrorCode.INTERNAL, "{log}", "python talks"),
    ],
)
def test_every_ending_is_reported(
    folder: LiftFolder, start: Start, behaviour: str, code: ErrorCode, told: str, logged: str
) -> None:
    if behaviour == "memory of torch":
        pytest.importorskip("torch")
    follower = start(behaviour)
    follow(follower)
    assert follower.state is TaskState.FAILED and follower.error is not None and follower.error.code is code
    assert told.format(scene=folder.request.scene, log=folder.log_path) in str(follower.error)
    assert "\n" not in str(follower.error)
    assert logged in folder.log_path.read_text()
    is_the_users = code is ErrorCode.BAD_INPUT
    assert any(logged in line for line in follower.log_lines) is not is_the_users
    assert folder.state() in (LiftState.FAILED, LiftState.INTERRUPTED)


def test_what_stops_it_before_it_begins_is_reported(folder: LiftFolder, start: Start) -> None:
    with folder.lock():
        follower = start("short")
        follow(follower)
    assert str(follower.error).startswith("another engine is at work")
    assert follower.error is not None and follower.error.code is ErrorCode.BUSY
    said = EngineProcess([sys.executable, "-c", "raise SystemExit('no such thing')"])
    nonsense = TaskFollower(folder.place, said, lift=folder)
    follow(nonsense)
    assert str(nonsense.error) == "no such thing"
    nonsense.close()


def test_a_finished_lift_is_left_as_it_is(folder: LiftFolder, start: Start) -> None:
    follow(start("short"))
    before = {path: path.stat().st_mtime_ns for path in folder.path.rglob("*")}
    again = start("short", resume=True)
    follow(again)
    assert again.state is TaskState.FINISHED
    refused = start("short")
    follow(refused)
    assert "begun before (finished)" in str(refused.error)
    assert {path: path.stat().st_mtime_ns for path in folder.path.rglob("*")} == before


def test_without_resume_a_begun_lift_is_refused(folder: LiftFolder, start: Start) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 2))
    follower.kill()
    follow(follower)
    before = folder.events_path.read_bytes()
    refused = start("short")
    follow(refused)
    assert "--resume" in str(refused.error)
    assert folder.events_path.read_bytes() == before


def test_a_folder_that_vanishes_during_the_lift_is_reported(folder: LiftFolder, start: Start) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 2))
    follower.kill()
    shutil.rmtree(folder.path)
    follow(follower)
    assert follower.state is TaskState.FAILED
    assert str(follower.error).startswith(f"the folder is gone: {folder.path}. ")
    assert "log" not in str(follower.error).replace(str(folder.path), "")
