"""How tests wait for what other processes and threads do: no longer than it takes, however busy the machine is."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 300.0
"""Only what never comes true takes this long, so a test that passes never does. Less than pyproject.toml's
faulthandler_timeout, after which a test hangs."""
OUTLASTS_S = 2 * PATIENCE_S
"""For what goes on until somebody ends it: nothing that waits for its end can be content with its end by itself."""


def wait_until(
    condition: Callable[[], object], what: object = "", patience_s: float = PATIENCE_S, pause_s: float = 0.02
) -> None:
    """Look again and again until `condition()` is true. It has to stay so: what passes by may do so between two looks.

    TimeoutError naming `what`, or what it returns, when it does not come true.
    """
    end = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"{what() if callable(what) else what}: not within {patience_s:g} s")
        time.sleep(pause_s)
