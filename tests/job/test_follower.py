"""Two processes: whatever happens to one, the other does the right thing."""

from __future__ import annotations

import shutil
import sys

import pytest

from engine.job import EventReader, ExitCode, LiftFolder, LiftState
from engine.job.follower import LiftFollower
from engine.job.process import EngineProcess
from tests.job.following import Start, code_of, follow, step_reached

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


def test_follows_to_the_end(folder: LiftFolder, start: Start) -> None:
    follower = start("short")
    follow(follower)
    assert follower.outcome is not None and follower.outcome.error is None
    assert code_of(follower) is ExitCode.FINISHED and folder.state() is LiftState.FINISHED
    assert follower.status.label == "Training" and follower.status.step == 1
    log = folder.log_path.read_text()
    assert "python talks\n" in log and "native code talks\n" in log


def test_cancel_stops_it_and_resume_goes_on(folder: LiftFolder, start: Start) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 3))
    follower.cancel()
    follow(follower)
    assert code_of(follower) is ExitCode.CANCELLED and folder.state() is LiftState.CANCELLED
    checkpoint = folder.checkpoints.latest()
    assert checkpoint is not None
    again = start("short", resume=True)
    follow(again)
    assert code_of(again) is ExitCode.FINISHED and not folder.cancel_path.exists()
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
def test_a_deaf_engine_has_half_a_second_and_less_than_a_whole_one(folder: LiftFolder, asked_by: str) -> None:
    now, engine = [100.0], DeafEngine()
    follower = LiftFollower(folder, engine, clock=lambda: now[0])
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
    assert code_of(follower) is ExitCode.CANCELLED


@pytest.mark.parametrize("behaviour", ["deaf", "holds the lock"])
def test_cancel_ends_a_deaf_engine(folder: LiftFolder, start: Start, behaviour: str) -> None:
    follower = start(behaviour)
    follow(follower, step_reached(follower, 5))
    folder.cancel_path.touch()  # somebody else asks
    follow(follower)
    assert code_of(follower) is ExitCode.CANCELLED
    assert folder.checkpoints.latest() is not None and not folder.is_running


def test_cancel_needs_no_room_on_the_disk(folder: LiftFolder, start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    follower = start("patient")
    follow(follower, step_reached(follower, 2))
    monkeypatch.setattr(LiftFolder, "ask_to_cancel", full)
    follower.cancel()
    follow(follower)
    assert code_of(follower) is ExitCode.CANCELLED


def test_a_killed_engine_is_told_and_can_be_resumed(folder: LiftFolder, start: Start) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 3))
    follower.kill()
    follow(follower)
    assert code_of(follower) is ExitCode.INTERNAL_ERROR
    assert follower.outcome is not None and "signal 9" in str(follower.outcome.error)
    assert folder.state() is LiftState.INTERRUPTED
    again = start("short", resume=True)
    follow(again)
    assert code_of(again) is ExitCode.FINISHED


@pytest.mark.parametrize(
    ("behaviour", "code", "told", "logged"),
    [
        ("bad input", ExitCode.BAD_INPUT, "is too dark: {scene}. Switch the light on.", "python talks"),
        ("broken", ExitCode.INTERNAL_ERROR, "ZeroDivisionError: no such luck", "Traceback"),
        ("memory", ExitCode.INTERNAL_ERROR, "memory ran out", "MemoryError"),
        ("segfault", ExitCode.INTERNAL_ERROR, "signal 11", "Segmentation fault"),
        ("exits", ExitCode.INTERNAL_ERROR, "{log}", "python talks"),
    ],
)
def test_every_end_is_told(
    folder: LiftFolder, start: Start, behaviour: str, code: ExitCode, told: str, logged: str
) -> None:
    follower = start(behaviour)
    follow(follower)
    assert code_of(follower) is code
    assert follower.outcome is not None and follower.outcome.error is not None
    assert told.format(scene=folder.request.scene, log=folder.log_path) in follower.outcome.error
    assert "\n" not in follower.outcome.error
    assert logged in folder.log_path.read_text()
    is_the_users = code is ExitCode.BAD_INPUT
    assert any(logged in line for line in follower.outcome.log_lines) is not is_the_users
    assert folder.state() in (LiftState.FAILED, LiftState.INTERRUPTED)


def test_what_stops_it_before_it_begins_is_told(folder: LiftFolder, start: Start) -> None:
    with folder.lock():
        follower = start("short")
        follow(follower)
    assert follower.outcome is not None and str(follower.outcome.error).startswith("another engine is at work")
    nonsense = LiftFollower(folder, EngineProcess([sys.executable, "-c", "raise SystemExit('no such thing')"]))
    follow(nonsense)
    assert nonsense.outcome is not None and nonsense.outcome.error == "no such thing"
    nonsense.close()


def test_a_finished_lift_is_left_as_it_is(folder: LiftFolder, start: Start) -> None:
    follow(start("short"))
    before = {path: path.stat().st_mtime_ns for path in folder.path.rglob("*")}
    again = start("short", resume=True)
    follow(again)
    assert code_of(again) is ExitCode.FINISHED
    refused = start("short")
    follow(refused)
    assert refused.outcome is not None and "begun before (finished)" in str(refused.outcome.error)
    assert {path: path.stat().st_mtime_ns for path in folder.path.rglob("*")} == before


def test_without_resume_a_begun_lift_is_refused(folder: LiftFolder, start: Start) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 2))
    follower.kill()
    follow(follower)
    before = folder.events_path.read_bytes()
    refused = start("short")
    follow(refused)
    assert refused.outcome is not None and "--resume" in str(refused.outcome.error)
    assert folder.events_path.read_bytes() == before


def test_a_folder_that_goes_during_the_lift_is_told(folder: LiftFolder, start: Start) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 2))
    follower.kill()
    shutil.rmtree(folder.path)
    follow(follower)
    assert follower.outcome is not None and code_of(follower) is ExitCode.INTERNAL_ERROR
    assert str(follower.outcome.error).startswith(f"the lift's folder is gone: {folder.path}. ")
    assert "log" not in str(follower.outcome.error).replace(str(folder.path), "")
