"""Lift folders, and how tests follow pretended engines, which outlast the patience of `follow`."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from engine.command_line.run_engine import run_engine
from engine.errors import ExitCode
from engine.job import EventWriter, LiftFolder, LiftRequest, StopSignal, write_atomically, write_manifest
from engine.job.follower import TaskFollower
from engine.job.task import LIFT
from tests.waiting import wait_until

FAKE = Path(__file__).parent / "fake_engine.py"
Start = Callable[..., TaskFollower]


def new_lift(tmp_path: Path, name: str = "lift", seed: int = 0) -> LiftFolder:
    """A folder that asks for a lift of a scene that need not be there."""
    return LiftFolder.create(tmp_path / name, LiftRequest(scene=tmp_path / "scene", seed=seed))


def tiny_lift(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
    """A lift that is over at once."""
    events.stage("train", 1, 1, "Training")
    stop.check()
    events.progress("train", 1, 1, loss=0.5, eta_s=0.0)
    made = folder.with_next_result().result_path
    write_atomically(made / "metrics.json", '{"format": 1, "test_frames": [], "tables": []}')
    write_manifest(made, versions={}, seed=folder.request.seed, settings={}, timings={"train": 0.0})
    folder.adopt_next_result()


def follow(follower: TaskFollower, until: Callable[[], bool] = lambda: False) -> None:
    """Poll until the end, or until something holds."""

    def is_there() -> bool:
        if not follower.is_running or until():
            return True
        follower.poll()
        return False

    wait_until(is_there, lambda: follower.progress)


def step_reached(follower: TaskFollower, step: int) -> Callable[[], bool]:
    return lambda: follower.progress.step >= step


def watch(folder: LiftFolder) -> TaskFollower:
    """Follow a lift that somebody else started."""
    return TaskFollower(folder.task_files, lift=folder)


def start_fake(folder: LiftFolder, behaviour: str, *more: str, stays_with_parent: bool = True) -> TaskFollower:
    """Start an engine that pretends to lift."""
    command = [sys.executable, FAKE, behaviour, folder.path, *more]
    return TaskFollower.start(command, folder.task_files, kind=LIFT, lift=folder, stays_with_parent=stays_with_parent)


def command_after_another(python: Path, lift: Path, *, resume: bool) -> list[str | Path]:
    """In place of `engine_command`: another engine does the lift before the one that the command starts begins."""
    assert run_engine(LiftFolder.open(lift), lift=tiny_lift) is ExitCode.FINISHED
    return [python, FAKE, "short", lift, *(["--resume"] if resume else [])]


COUNTERS = Path("/proc/self/io")


def bytes_read() -> int:
    """Bytes that this process has read so far, as Linux counts them. Skips the test where nobody counts."""
    if not COUNTERS.exists():
        pytest.skip("needs Linux's count of bytes read")
    counts = dict(line.split(": ") for line in COUNTERS.read_text().splitlines())
    return int(counts["rchar"])
