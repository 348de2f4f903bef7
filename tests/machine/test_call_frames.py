"""With room for frames, no call asks the system for memory."""

from __future__ import annotations

import sys

import pytest

from engine.machine.call_frames import with_room

resource = pytest.importorskip("resource", reason="needs the count of page faults")


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


def test_room_ends_the_asking() -> None:
    assert with_room(leaf, 2, 3) == 5
    assert with_room(call_often_below, 300) < 50


@pytest.mark.skipif(sys.version_info < (3, 11), reason="versions before keep frames elsewhere")
def test_without_it_some_call_asks_every_time() -> None:
    assert call_often_below(300) >= 500
