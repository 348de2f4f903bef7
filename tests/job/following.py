"""How tests follow engines that only pretend.

Nothing here measures time: an engine that nobody ends would go on for longer than `follow` has patience.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from engine.job import ExitCode
from engine.job.follower import LiftFollower

FAKE = Path(__file__).parent / "fake_engine.py"
Start = Callable[..., LiftFollower]


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
