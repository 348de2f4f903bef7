"""Lifts that this Blender follows, with a real engine process around a pretended lift."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from plgs.engine.errors import ErrorCode
from plgs.engine.job import EventWriter, LiftFolder, LiftRequest, LiftState
from plgs.engine.job.events import MOST_BYTES
from plgs.plgs_blender import registry
from plgs.plgs_blender.running import lifts

from tests.waiting import wait_until

ENGINE = Path(__file__).resolve().parents[2] / "job" / "fake_engine.py"
PYTHON = Path(sys.executable)
Behaves = Callable[..., None]
SCENE = SimpleNamespace(plgs=SimpleNamespace(place_when_done=False))
"""In the place of Blender's scene: a pretended lift has nothing to show."""


@pytest.fixture(autouse=True)
def nothing_followed() -> Iterator[None]:
    yield
    registry.forget_all()


@pytest.fixture
def behaves(monkeypatch: pytest.MonkeyPatch) -> Behaves:
    """Chooses what the engine's lift does."""

    def choose(behaviour: str, *options: str) -> None:
        def command(python: Path, lift: Path, *, resume: bool) -> list[str | Path]:
            return [python, ENGINE, behaviour, lift, *options, *(["--resume"] if resume else [])]

        monkeypatch.setattr(lifts, "engine_command", command)

    return choose


@pytest.fixture
def lift(tmp_path: Path) -> LiftFolder:
    return LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path / "room"))


def poll_until(followed: lifts.Lift, condition: Callable[[], bool]) -> None:
    def is_there() -> bool:
        registry.poll_all(SCENE)
        return condition()

    wait_until(is_there, lambda: followed.progress)


def test_a_cancelled_lift_that_is_opened_never_looks_as_if_it_ran(lift: LiftFolder) -> None:
    events = EventWriter(lift.events_path)
    events.hello(threads=2, resumed=False)
    for step in range(3000):  # more than a poll reads
        events.progress("train", step, 3000, loss=0.1, eta_s=1.5, left_s=300.0)
    events.done("cancelled")
    events.close()
    assert lift.events_path.stat().st_size > 2 * MOST_BYTES
    followed = lifts.attach(lift.path)
    assert not followed.is_running and followed.was_cancelled and followed.can_be_resumed


def test_a_lift_from_start_to_end(behaves: Behaves, lift: LiftFolder) -> None:
    behaves("short")
    followed = lifts.start(lift, PYTHON)
    assert followed.is_running and lifts.running() == [followed] and lifts.lift_of(lift.path) is followed
    registry.wait_for(followed, SCENE)
    assert followed.has_finished and followed.is_finished and not followed.can_be_resumed and lifts.running() == []
    assert followed.message == "The lift is finished"


def test_cancelled_and_resumed(behaves: Behaves, lift: LiftFolder) -> None:
    behaves("long")
    followed = lifts.start(lift, PYTHON)
    poll_until(followed, lambda: followed.progress.step > 5)
    followed.cancel()
    registry.wait_for(followed, SCENE)
    assert followed.was_cancelled and followed.can_be_resumed and followed.error is None
    reached = followed.progress.step
    behaves("long")
    again = lifts.start(lift, PYTHON, resume=True)
    poll_until(again, lambda: again.progress.step > 0)
    assert again.progress.step > reached - 2, "it went on where it was"


@pytest.mark.parametrize("behaviour", ["broken", "memory", "segfault", "exits"])
def test_an_engine_that_dies_leaves_a_message(behaves: Behaves, lift: LiftFolder, behaviour: str) -> None:
    behaves(behaviour)
    followed = lifts.start(lift, PYTHON)
    registry.wait_for(followed, SCENE)
    code = ErrorCode.KILLED if behaviour == "segfault" else ErrorCode.INTERNAL
    assert followed.error is not None and followed.error.code is code and followed.can_be_resumed


def test_another_blender_watches_and_cancels(behaves: Behaves, lift: LiftFolder) -> None:
    """Two followers of one folder, the second without a process, as in another Blender."""
    behaves("long")
    ours = lifts.start(lift, PYTHON)
    poll_until(ours, lambda: ours.progress.step > 3)
    registry._tasks.clear()  # as if this were another process
    theirs = lifts.attach(lift.path)
    assert theirs is not ours and theirs.is_running
    poll_until(theirs, lambda: theirs.progress.step > 3)
    theirs.cancel()
    registry.wait_for(theirs, SCENE)
    assert theirs.was_cancelled and theirs.lift_state is LiftState.CANCELLED
    ours.let_go()


def test_looking_at_what_is_not_a_lift(tmp_path: Path) -> None:
    assert lifts.look_at(tmp_path / "nothing") is None and lifts.refusal_of(tmp_path / "nothing") is None
    (tmp_path / "folder").mkdir()
    assert lifts.look_at(tmp_path / "folder") is None
    assert lifts.refusal_of(tmp_path / "folder").key == "not-lift-folder"


def test_a_folder_that_was_not_started_can_be_resumed(lift: LiftFolder) -> None:
    followed = lifts.attach(lift.path)
    assert followed.lift_state is LiftState.NOT_STARTED and followed.can_be_resumed and not followed.is_running


def test_the_folder_is_deleted_while_it_lifts(behaves: Behaves, lift: LiftFolder) -> None:
    behaves("long")
    followed = lifts.start(lift, PYTHON)
    poll_until(followed, lambda: followed.progress.step > 0)
    followed.follower.kill()
    shutil.rmtree(lift.path)
    registry.wait_for(followed, SCENE)
    assert followed.error is not None and followed.error.key == "folder-gone"


def test_a_lift_that_can_no_longer_be_read_ends(lift: LiftFolder) -> None:
    with lift.lock():
        followed = lifts.attach(lift.path)
        assert followed.is_running
    lift.events_path.unlink()
    lift.events_path.mkdir()
    assert followed.poll(SCENE) and not followed.is_running
    assert followed.error.key == "unfollowed"
