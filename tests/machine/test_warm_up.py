"""What is compiled before the first pass, and by whom."""

from __future__ import annotations

import logging

import pytest

from engine.machine import warm_up
from engine.machine.warm_up import WarmUp


def steps(monkeypatch: pytest.MonkeyPatch, compiled: set[str], backward_follows: bool) -> list[str]:
    """What a warm-up does where these passes have been compiled before."""
    done: list[str] = []

    class Recorded:
        def __init__(self, module: str) -> None:
            done.append(f"start {module}")

        def wait(self) -> None:
            done.append("wait")

    monkeypatch.setattr(warm_up, "Companion", Recorded)
    monkeypatch.setattr(warm_up, "has_room_for_two", lambda: True)
    monkeypatch.setattr(warm_up, "is_compiled", lambda what: what.split()[1] in compiled)
    monkeypatch.setattr(warm_up, "note_compiled", lambda what: None)
    own = WarmUp("test", lambda: done.append("forward"), lambda: done.append("backward"), "apart")
    for _ in range(2):
        own.forward(backward_follows)
    for _ in range(2 if backward_follows else 0):
        own.backward()
    return done


def test_two_processes_share_a_cold_start(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    assert steps(monkeypatch, set(), True) == ["start apart", "forward", "wait", "backward"]
    assert len(caplog.records) == 1


@pytest.mark.parametrize("compiled", [{"forward"}, {"backward"}, {"forward", "backward"}])
def test_one_process_does_the_rest(compiled: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert steps(monkeypatch, compiled, True) == ["forward", "backward"]


def test_who_only_draws_compiles_only_that(monkeypatch: pytest.MonkeyPatch) -> None:
    assert steps(monkeypatch, set(), False) == ["forward"]
