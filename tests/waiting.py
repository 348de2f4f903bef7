"""How tests wait for what other processes and threads do: no longer than it takes, however busy the machine is."""

import time
from collections.abc import Callable

PATIENCE_S = 300.0
"""A passing test never waits this long. Less than pyproject.toml's faulthandler_timeout, after which a test hangs."""
OUTLASTS_S = 2 * PATIENCE_S
"""For what goes on until somebody ends it: nothing that waits for its end can be content with its end by itself."""


def wait_until(
    condition: Callable[[], object], what: object = "", patience_s: float = PATIENCE_S, pause_s: float = 0.02
) -> None:
    """Poll until `condition()` is true, and it must stay so. TimeoutError names `what`, or what it returns."""
    end = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"{what() if callable(what) else what}: not within {patience_s:g} s")
        time.sleep(pause_s)
