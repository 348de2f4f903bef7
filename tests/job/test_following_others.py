"""Engines that another process started, and those that outlive the one that did."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from engine.job import ExitCode, LiftFolder, LiftState
from engine.job.follower import LiftFollower
from tests.job.following import FAKE, Start, code_of, follow, step_reached

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


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
