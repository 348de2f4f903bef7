"""Two processes: whatever happens to one, the other does the right thing.

Nothing here measures time: an engine that nobody ends would go on for longer than `follow` has patience.
"""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from engine.job import EventReader, EventWriter, ExitCode, LiftFolder, LiftState
from engine.job.events import MOST_BYTES, TAIL_BYTES
from engine.job.follower import LiftFollower
from engine.job.lock import FileLock
from engine.job.process import EngineProcess
from tests.job.bytes_read import bytes_read
from tests.job.lift_folders import new_lift

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
FAKE = Path(__file__).parent / "fake_engine.py"
Start = Callable[..., LiftFollower]


@pytest.fixture
def folder(tmp_path: Path) -> LiftFolder:
    return new_lift(tmp_path)


@pytest.fixture
def start(folder: LiftFolder) -> Iterator[Start]:
    followers = []

    def start_one(behaviour: str, resume: bool = False) -> LiftFollower:
        command = [sys.executable, FAKE, behaviour, folder.path, *(["--resume"] if resume else [])]
        followers.append(LiftFollower.start(folder, resume=resume, command=command))
        return followers[-1]

    yield start_one
    for follower in followers:
        follower.kill()
        follower.close()


def follow(follower: LiftFollower, until: Callable[[], bool] = lambda: False) -> None:
    """Poll until the end, or until something holds."""
    began = time.monotonic()
    while follower.outcome is None and not until():
        assert time.monotonic() - began < 25.0, follower.status
        follower.poll()
        time.sleep(0.02)


def step_reached(follower: LiftFollower, step: int) -> Callable[[], bool]:
    return lambda: follower.status.step >= step


def code_of(follower: LiftFollower) -> ExitCode:
    assert follower.outcome is not None
    return follower.outcome.code


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


@pytest.mark.parametrize("behaviour", ["patient", "deaf"])
def test_the_engine_ends_when_its_parent_is_killed(folder: LiftFolder, root: Path, behaviour: str) -> None:
    code = (
        "import sys, time; from pathlib import Path; from engine.job.process import EngineProcess\n"
        "process = EngineProcess(sys.argv[1:]); time.sleep(60)"
    )
    command = [sys.executable, "-c", code, sys.executable, FAKE, behaviour, folder.path]
    with subprocess.Popen(command, cwd=root) as parent:
        watcher = LiftFollower(folder)
        began = time.monotonic()
        while watcher.status.step < 5:
            assert time.monotonic() - began < 20
            watcher.outcome = None  # until the engine holds its lock it looks as if nobody worked there
            watcher.poll()
            time.sleep(0.02)
        assert folder.is_running
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        follow(watcher)
    assert folder.state() is LiftState.CANCELLED


def test_watching_somebody_elses_engine(folder: LiftFolder, start: Start) -> None:
    own = start("patient")
    follow(own, step_reached(own, 2))
    watcher = LiftFollower(folder)
    watcher.poll()
    assert watcher.outcome is None and watcher.status.step >= 2
    watcher.cancel()
    follow(watcher)
    assert code_of(watcher) is ExitCode.CANCELLED


def start_parent(root: Path, folder: LiftFolder, behaviour: str) -> subprocess.Popen[bytes]:
    """A process that starts an engine which goes on without it, and is then in the way of nobody."""
    code = (
        "import sys, time; from pathlib import Path; from engine.job import LiftFolder\n"
        "from engine.job.follower import LiftFollower\n"
        "folder = LiftFolder.open(Path(sys.argv[4]))\n"
        "LiftFollower.start(folder, resume=False, command=sys.argv[1:], stays_with_parent=False); time.sleep(60)"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code, sys.executable, FAKE, behaviour, folder.path, "--go-on"], cwd=root
    )


def reattached(folder: LiftFolder) -> LiftFollower:
    """As a new Blender would, as soon as an engine is at work."""
    began = time.monotonic()
    while not folder.is_running:
        assert time.monotonic() - began < 20
        time.sleep(0.02)
    return LiftFollower(folder)


def test_an_engine_that_goes_on_without_its_parent(folder: LiftFolder, root: Path) -> None:
    with start_parent(root, folder, "patient") as parent:
        watcher = reattached(folder)
        follow(watcher, step_reached(watcher, 5))
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    step = watcher.status.step
    later = LiftFollower(folder)  # a new Blender
    follow(later, step_reached(later, step + 10))
    assert later.outcome is None and folder.is_running
    later.cancel()
    follow(later)
    assert code_of(later) is ExitCode.CANCELLED and folder.state() is LiftState.CANCELLED


@pytest.mark.parametrize(("behaviour", "told"), [("segfault", "Segmentation fault"), ("memory", "MemoryError")])
def test_a_crash_is_told_to_who_comes_later(folder: LiftFolder, start: Start, behaviour: str, told: str) -> None:
    failed = start("broken")
    follow(failed)
    follow(start(behaviour, resume=True))
    watcher = LiftFollower(folder)
    follow(watcher)
    assert watcher.outcome is not None and watcher.outcome.code is ExitCode.INTERNAL_ERROR
    assert "no such luck" not in str(watcher.outcome.error)  # that was the run before
    assert any(told in line for line in watcher.outcome.log_lines)


def test_a_kill_is_told_to_who_comes_later(folder: LiftFolder, start: Start) -> None:
    own = start("patient")
    follow(own, step_reached(own, 3))
    watcher = LiftFollower(folder)
    watcher.poll()
    own.kill()
    follow(watcher)
    assert watcher.outcome is not None and "killed, or out of memory" in str(watcher.outcome.error)
    assert any("python talks" in line for line in watcher.outcome.log_lines)


def test_an_engine_of_ones_own_that_goes_on(folder: LiftFolder) -> None:
    def start_one(behaviour: str, *more: str) -> LiftFollower:
        command = [sys.executable, FAKE, behaviour, folder.path, "--go-on", *more]
        return LiftFollower.start(folder, resume=bool(more), command=command, stays_with_parent=False)

    first = start_one("patient")
    follow(first, step_reached(first, 3))
    first.close()
    second = start_one("short", "--resume")
    follow(second)
    assert second.outcome is not None and "another engine is at work" in str(second.outcome.error)
    watcher = LiftFollower(folder)
    follow(watcher, step_reached(watcher, 6))
    assert watcher.outcome is None
    watcher.cancel()
    follow(watcher)
    third = start_one("deaf", "--resume")
    follow(third, step_reached(third, watcher.status.step + 1))
    third.cancel()
    follow(third)
    assert code_of(third) is ExitCode.CANCELLED and not folder.is_running


def test_a_poll_takes_little_however_much_was_told(folder: LiftFolder) -> None:
    events = EventWriter(folder.events_path)
    events.hello(threads=1, resumed=False)
    events.stage("train", 1, 1, "Training")
    events.close()
    line = '{"seq": 3, "time": 1.5, "event": "%s", "stage": "train", "step": %d, "steps": 90000, "message": ""}\n'
    with folder.events_path.open("a") as file:
        file.writelines(line % ("warning" if step % 25 == 0 else "progress", step) for step in range(60000))
    with folder.lock():
        watcher = LiftFollower(folder)
        while watcher.status.step < 59999:
            before, step = bytes_read(), watcher.status.step
            events_of_one_poll = watcher.poll()
            assert bytes_read() - before < 2 * MOST_BYTES
            assert watcher.outcome is None and watcher.status.step > step
            assert len(events_of_one_poll) < 0.1 * MOST_BYTES / len(line), "outdated progress is left out"
        before = bytes_read()
        folder.state()
        assert bytes_read() - before < 3 * TAIL_BYTES
    watcher.poll()
    assert watcher.outcome is not None and watcher.status.label == "Training"


@pytest.mark.parametrize(
    ("state", "code"),
    [("finished", ExitCode.FINISHED), ("cancelled", ExitCode.CANCELLED), (None, ExitCode.INTERNAL_ERROR)],
)
def test_how_a_bake_ended_is_not_how_the_lift_is(
    folder: LiftFolder, start: Start, state: str | None, code: ExitCode
) -> None:
    follow(start("short"))
    events = EventWriter(folder.events_path)
    events.hello(threads=1, resumed=False, task="bake")
    events.stage("bake", 1, 1, "Baking")
    if state is not None:
        events.done(state)
    events.close()
    watcher = LiftFollower(folder)
    follow(watcher)
    assert watcher.status.task == "bake" and code_of(watcher) is code
    assert folder.state() is LiftState.FINISHED


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "1" + "0" * 400, '"x"', "null"])
def test_numbers_that_are_none_are_passed_over(folder: LiftFolder, number: str) -> None:
    line = f'{{"seq": 1, "time": 0, "event": "progress", "step": {number}, "steps": 9, "loss": 1, "eta_s": {number}}}'
    folder.events_path.write_text(line + "\n")
    watcher = LiftFollower(folder)
    watcher.poll()
    status = watcher.status
    assert (status.step, status.steps, status.loss, status.eta_s) == (0, 9, 1.0, None)


def test_a_folder_that_goes_during_the_lift_is_told(folder: LiftFolder, start: Start) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 2))
    follower.kill()
    shutil.rmtree(folder.path)
    follow(follower)
    assert follower.outcome is not None and code_of(follower) is ExitCode.INTERNAL_ERROR
    assert str(follower.outcome.error).startswith(f"the lift's folder is gone: {folder.path}. ")
    assert "log" not in str(follower.outcome.error).replace(str(folder.path), "")


@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE])
def test_a_disk_that_does_not_answer_for_a_moment_ends_no_lift(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    folder, now = new_lift(tmp_path), [0.0]
    writer = EventWriter(folder.events_path)
    writer.hello(threads=1, resumed=False)
    watcher = LiftFollower(folder, clock=lambda: now[0])

    def no_answer(*_: object, **__: object) -> object:
        raise OSError(number, os.strerror(number))

    with FileLock(folder.events_path):
        watcher.poll()
        writer.warning("goes on")
        for module in ("engine.job.lock", "engine.job.events"):
            with monkeypatch.context() as patch:
                patch.setattr(f"{module}.open_plain", no_answer)
                now[0] += 4.0
                assert watcher.poll() == [] and watcher.outcome is None
        now[0] += 100.0
        assert [event.kind for event in watcher.poll()] == ["warning"] and watcher.outcome is None
        monkeypatch.setattr("engine.job.events.open_plain", no_answer)
        assert watcher.poll() == []
        now[0] += 100.0
        with pytest.raises(OSError):
            watcher.poll()
