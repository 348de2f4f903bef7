"""Polling a set-up as a timer would."""

from __future__ import annotations

import time
from collections.abc import Callable

from plgs.plgs_blender.engine_environment.progress import Outcome
from plgs.plgs_blender.engine_environment.set_up import SetUp


def follow(set_up: SetUp, until: Callable[[], bool] = lambda: False, patience_s: float = 60.0) -> Outcome | None:
    """Poll until the end, or until something holds."""
    give_up = time.monotonic() + patience_s
    while set_up.outcome is None and not until():
        assert time.monotonic() < give_up, set_up.progress
        set_up.poll()
        time.sleep(0.02)
    return set_up.outcome
