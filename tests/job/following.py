"""How tests follow engines that only pretend.

Nothing here measures time: an engine that nobody ends would go on for longer than `follow` has patience.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

from engine.job import LiftFolder
from engine.job.follower import TaskFollower
from engine.job.task import LIFT

FAKE = Path(__file__).parent / "fake_engine.py"
Start = Callable[..., TaskFollower]


def follow(follower: TaskFollower, until: Callable[[], bool] = lambda: False) -> None:
    """Poll until the end, or until something holds."""
    began = time.monotonic()
    while follower.is_running and not until():
        assert time.monotonic() - began < 60.0, follower.progress
        follower.poll()
        time.sleep(0.02)


def step_reached(follower: TaskFollower, step: int) -> Callable[[], bool]:
    return lambda: follower.progress.step >= step


def watch(folder: LiftFolder) -> TaskFollower:
    """Follow a lift that somebody else started."""
    return TaskFollower.attach(folder.place, lift=folder)


def start_fake(folder: LiftFolder, behaviour: str, *more: str, stays_with_parent: bool = True) -> TaskFollower:
    """Start an engine that pretends to lift."""
    command = [sys.executable, FAKE, behaviour, folder.path, *more]
    return TaskFollower.start(command, folder.place, kind=LIFT, lift=folder, stays_with_parent=stays_with_parent)
