"""Engines that another process started, and those that outlive the one that did."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from engine.errors import ErrorCode
from engine.job import LiftFolder, LiftState
from engine.job.follower import TaskFollower
from engine.job.task import TaskState
from tests.job.following import FAKE, Start, follow, start_fake, step_reached, watch
from tests.waiting import wait_until

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


def test_watching_somebody_elses_engine(folder: LiftFolder, start: Start) -> None:
    own = start("patient")
    follow(own, step_reached(own, 2))
    watcher = watch(folder)
    watcher.poll()
    assert watcher.is_running and watcher.progress.step >= 2
    watcher.cancel()
    follow(watcher)
    assert watcher.state is TaskState.CANCELLED


def start_parent(root: Path, folder: LiftFolder, behaviour: str) -> subprocess.Popen[bytes]:
    """A process that starts an engine which goes on without it, and is then in the way of nobody."""
    code = (
        "import sys, time; from pathlib import Path; from engine.job import LiftFolder\n"
        "from tests.job.following import start_fake\n"
        "start_fake(LiftFolder.open(Path(sys.argv[2])), sys.argv[1], stays_with_parent=False); time.sleep(600)"
    )
    return subprocess.Popen([sys.executable, "-c", code, behaviour, folder.path], cwd=root)


def reattached(folder: LiftFolder) -> TaskFollower:
    """As a new Blender would, as soon as an engine is at work."""
    wait_until(lambda: folder.is_running, folder.path)
    return watch(folder)


def test_an_engine_that_outlives_its_parent(folder: LiftFolder, root: Path) -> None:
    with start_parent(root, folder, "patient") as parent:
        watcher = reattached(folder)
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


@pytest.mark.parametrize("behaviour", ["patient", "deaf"])
def test_the_engine_ends_when_its_parent_is_killed(folder: LiftFolder, root: Path, behaviour: str) -> None:
    code = (
        "import sys, time; from pathlib import Path; from engine.job.process import EngineProcess\n"
        "process = EngineProcess(sys.argv[1:]); time.sleep(600)"
    )
    command = [sys.executable, "-c", code, sys.executable, FAKE, behaviour, folder.path, "--stay-with-parent"]
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


@pytest.mark.parametrize(("behaviour", "told"), [("segfault", "Segmentation fault"), ("memory", "MemoryError")])
def test_a_crash_is_reported_to_later_followers(folder: LiftFolder, start: Start, behaviour: str, told: str) -> None:
    failed = start("broken")
    follow(failed)
    follow(start(behaviour, resume=True))
    watcher = watch(folder)
    follow(watcher)
    assert watcher.error is not None and watcher.error.code is ErrorCode.INTERNAL
    assert "no such luck" not in str(watcher.error)  # that was the run before
    assert any(told in line for line in watcher.log_lines)


def test_a_kill_is_reported_to_later_followers(folder: LiftFolder, start: Start) -> None:
    own = start("patient")
    follow(own, step_reached(own, 3))
    watcher = watch(folder)
    watcher.poll()
    own.kill()
    follow(watcher)
    assert "killed, or out of memory" in str(watcher.error)
    assert any("python talks" in line for line in watcher.log_lines)


def test_ones_own_engine_that_keeps_running(folder: LiftFolder) -> None:
    def start_one(behaviour: str, *more: str) -> TaskFollower:
        return start_fake(folder, behaviour, *more, stays_with_parent=False)

    first = start_one("patient")
    follow(first, step_reached(first, 3))
    first.close()
    second = start_one("short", "--resume")
    follow(second)
    assert "another engine is at work" in str(second.error)
    watcher = watch(folder)
    follow(watcher, step_reached(watcher, 6))
    assert watcher.is_running
    watcher.cancel()
    follow(watcher)
    third = start_one("deaf", "--resume")
    follow(third, step_reached(third, watcher.progress.step + 1))
    third.cancel()
    follow(third)
    assert third.state is TaskState.CANCELLED and not folder.is_running
