"""With room for frames no call asks the system for memory, and no search for dead cycles comes between."""

from __future__ import annotations

import gc
import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from engine.machine.undisturbed import undisturbed

if sys.platform != "win32":
    import resource

counts_faults = pytest.mark.skipif(sys.platform == "win32", reason="needs the count of page faults")


def leaf(a: int, b: int) -> int:
    return a + b


def call_often_below(depth: int) -> int:
    """Page faults of the deepest of ``depth`` levels, each of which calls a function 500 times."""
    if depth > 0:
        return max(call_often_below(depth - 1), _faults())
    return _faults()


def _faults() -> int:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for i in range(500):
        leaf(i, i)
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)


@counts_faults
def test_room_ends_the_asking() -> None:
    assert undisturbed(leaf, 2, 3) == 5
    assert undisturbed(call_often_below, 300) < 50


@counts_faults
@pytest.mark.skipif(sys.version_info < (3, 11), reason="versions before keep frames elsewhere")
def test_without_it_some_call_asks_every_time() -> None:
    assert call_often_below(300) >= 500


def test_nobody_looks_for_cycles_meanwhile() -> None:
    assert gc.isenabled()
    assert not undisturbed(gc.isenabled)
    assert gc.isenabled()


def test_afterwards_all_is_as_before_whatever_happened() -> None:
    with pytest.raises(ZeroDivisionError):
        undisturbed(divmod, 1, 0)
    assert gc.isenabled()
    gc.disable()
    try:
        undisturbed(leaf, 1, 2)
        assert not gc.isenabled()
    finally:
        gc.enable()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes are forked here")
def test_a_process_forked_meanwhile_looks_again() -> None:
    def fork() -> int:
        child = os.fork()
        if child == 0:
            os._exit(0 if gc.isenabled() else 1)
        return os.waitpid(child, 0)[1]

    with ThreadPoolExecutor(1) as pool:
        began, end = threading.Event(), threading.Event()
        compiling = pool.submit(undisturbed, lambda: (began.set(), end.wait(10)))
        began.wait()
        status = fork()
        end.set()
        compiling.result()
    assert status == 0


def test_an_interrupt_leaves_nothing_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    switch_off = gc.disable

    def interrupted() -> None:
        switch_off()
        raise KeyboardInterrupt

    monkeypatch.setattr(gc, "disable", interrupted)
    with pytest.raises(KeyboardInterrupt):
        undisturbed(leaf, 1, 2)
    assert gc.isenabled()
