"""Two processes: whatever happens to one, the other does the right thing."""

import shutil
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from engine.errors import ErrorCode
from engine.job import EventReader, LiftFolder, LiftState
from engine.job.follower import TaskFollower
from engine.job.process import EngineProcess
from engine.job.task import TaskFiles, TaskState
from tests.job.following import FAKE, Start, follow, start_fake, step_reached, watch
from tests.raises_key import worded
from tests.waiting import wait_until

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


def test_an_engine_process_is_followed_to_its_end(folder: LiftFolder, start: Start) -> None:
    follower = start("short")
    follow(follower)
    assert follower.error is None
    assert follower.state is TaskState.FINISHED and folder.state() is LiftState.FINISHED
    assert follower.progress.label == "Training" and follower.progress.step == 1
    log = folder.log_path.read_text()
    assert "python talks\n" in log and "native code talks\n" in log


def test_a_cancelled_lift_resumes_without_repeating_steps(folder: LiftFolder, start: Start) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 3))
    follower.cancel()
    follow(follower)
    assert follower.state is TaskState.CANCELLED and folder.state() is LiftState.CANCELLED
    assert folder.checkpoints.latest() is not None
    again = start("short", resume=True)
    follow(again)
    assert again.state is TaskState.FINISHED and not folder.cancel_path.exists()
    steps = [event.data["step"] for event in EventReader(folder.events_path).poll() if event.kind == "progress"]
    assert steps == [*range(1, 11), 1]  # no step was done twice; the last one is the tiny lift's own


class DeafEngine:
    """An engine that runs until it is killed."""

    pid = 0

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
def test_a_hanging_engine_is_ended_after_half_to_one_second(folder: LiftFolder, asked_by: str) -> None:
    now, engine = [100.0], DeafEngine()
    follower = TaskFollower(folder.task_files, engine, lift=folder, clock=lambda: now[0])
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


def test_cancelling_works_on_a_full_disk(folder: LiftFolder, start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 2))
    monkeypatch.setattr(TaskFiles, "ask_to_cancel", Mock(side_effect=OSError(28, "No space left on device")))
    follower.cancel()
    follow(follower)
    assert follower.state is TaskState.CANCELLED and not folder.cancel_path.exists()


def test_cancelling_does_not_write_through_a_link(folder: LiftFolder, start: Start, tmp_path: Path) -> None:
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
    assert follower.error.key == "killed"
    assert folder.state() is LiftState.INTERRUPTED
    again = start("short", resume=True)
    follow(again)
    assert again.state is TaskState.FINISHED


@pytest.mark.parametrize(
    ("behaviour", "code", "told", "logged"),
    [
        ("bad input", ErrorCode.BAD_INPUT, "{scene} is too dark. Switch the light on.", "python talks"),
        ("broken", ErrorCode.INTERNAL, "ZeroDivisionError: no such luck", "Traceback"),
        ("memory", ErrorCode.INTERNAL, "memory ran out", "MemoryError"),
        ("memory of torch", ErrorCode.INTERNAL, "memory ran out", "DefaultCPUAllocator"),
        ("segfault", ErrorCode.KILLED, "signal 11: ", "Segmentation fault"),
        ("exits", ErrorCode.INTERNAL, "{log}", "python talks"),
    ],
)
def test_every_way_an_engine_can_end_is_reported(
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


def test_an_engine_that_fails_to_start_is_reported(folder: LiftFolder, start: Start) -> None:
    with folder.lock():
        follower = start("short")
        follow(follower)
    assert str(follower.error).startswith("another engine is at work")
    assert follower.error is not None and follower.error.code is ErrorCode.BUSY
    said = EngineProcess([sys.executable, "-c", "raise SystemExit('no such thing')"])
    nonsense = TaskFollower(folder.task_files, said, lift=folder)
    follow(nonsense)
    assert str(nonsense.error) == "no such thing"
    nonsense.close()


def test_a_folder_that_vanishes_during_the_lift_is_reported(folder: LiftFolder, start: Start) -> None:
    follower = start("patient")
    follow(follower, step_reached(follower, 2))
    follower.kill()
    shutil.rmtree(folder.path)
    follow(follower)
    assert follower.state is TaskState.FAILED
    assert follower.error.key == "folder-gone" and follower.error.where == str(folder.path)


def start_parent(root: Path, folder: LiftFolder, behaviour: str) -> subprocess.Popen[bytes]:
    """A process that starts an engine which goes on without it, and is then in the way of nobody."""
    code = (
        "import sys, time; from pathlib import Path; from engine.job import LiftFolder\n"
        "from tests.job.following import start_fake\n"
        "start_fake(LiftFolder.open(Path(sys.argv[2])), sys.argv[1], stays_with_parent=False); time.sleep(600)"
    )
    return subprocess.Popen([sys.executable, "-c", code, behaviour, folder.path], cwd=root)


def test_an_engine_can_outlive_its_parent_process(folder: LiftFolder, root: Path) -> None:
    with start_parent(root, folder, "patient") as parent:
        wait_until(lambda: folder.is_running, folder.path)
        watcher = watch(folder)
        follow(watcher, step_reached(watcher, 5))
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    step = watcher.progress.step
    later = watch(folder)  # a new Blender
    follow(later, step_reached(later, step + 10))
    assert later.is_running and folder.is_running
    later.cancel()
    follow(later)
    assert later.state is TaskState.CANCELLED and folder.state() is LiftState.CANCELLED


def test_an_engine_ends_when_its_parent_process_is_killed(folder: LiftFolder, root: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from engine.job.process import EngineProcess\n"
        "process = EngineProcess(sys.argv[1:]); time.sleep(600)"
    )
    command = [sys.executable, "-c", code, sys.executable, FAKE, "deaf", folder.path, "--stay-with-parent"]
    with subprocess.Popen(command, cwd=root) as parent:
        watcher = watch(folder)

        def has_begun() -> bool:
            watcher.state = TaskState.RUNNING  # until the engine holds its lock it looks as if nobody worked there
            watcher.poll()
            return watcher.progress.step >= 5

        wait_until(has_begun, lambda: watcher.progress)
        assert folder.is_running
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        follow(watcher)
    assert folder.state() is LiftState.CANCELLED


def test_an_engines_crash_is_reported_to_programs_that_look_later(folder: LiftFolder, start: Start) -> None:
    failed = start("broken")
    follow(failed)
    follow(start("segfault", resume=True))
    watcher = watch(folder)
    follow(watcher)
    assert watcher.error is not None and watcher.error.code is ErrorCode.INTERNAL
    assert "no such luck" not in str(watcher.error)  # that was the run before
    assert any("Segmentation fault" in line for line in watcher.log_lines)


def test_an_engines_kill_is_reported_to_programs_that_look_later(folder: LiftFolder, start: Start) -> None:
    own = start("patient")
    follow(own, step_reached(own, 3))
    watcher = watch(folder)
    watcher.poll()
    own.kill()
    follow(watcher)
    assert watcher.error.key == "no-message"
    assert any("python talks" in line for line in watcher.log_lines)


def test_an_engine_may_run_on_after_its_follower_is_closed(folder: LiftFolder) -> None:
    first = start_fake(folder, "patient", stays_with_parent=False)
    follow(first, step_reached(first, 3))
    first.close()
    second = start_fake(folder, "short", "--resume", stays_with_parent=False)
    follow(second)
    assert worded("at-work").search(str(second.error))
    watcher = watch(folder)
    follow(watcher, step_reached(watcher, 6))
    assert watcher.is_running
    watcher.cancel()
    follow(watcher)
    assert watcher.state is TaskState.CANCELLED and not folder.is_running
