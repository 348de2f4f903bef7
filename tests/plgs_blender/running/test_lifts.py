"""Lifts that this Blender follows, with a real engine process around a pretended lift."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from plgs.engine.job import EventWriter, LiftFolder, LiftRequest, LiftState
from plgs.engine.job.events import MOST_BYTES
from plgs.plgs_blender import registry
from plgs.plgs_blender.running import lifts

from tests.waiting import wait_until

ENGINE = Path(__file__).resolve().parents[2] / "job" / "fake_engine.py"
PYTHON = Path(sys.executable)
SCENE = SimpleNamespace(plgs=SimpleNamespace(place_when_done=False))
"""In the place of Blender's scene: a pretended lift has nothing to show."""


@pytest.fixture
def lift(tmp_path: Path) -> LiftFolder:
    return LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path / "room"))


def test_an_opened_cancelled_lift_is_never_shown_as_running(lift: LiftFolder) -> None:
    events = EventWriter(lift.events_path)
    events.hello(threads=2, resumed=False)
    for step in range(3000):  # more than a poll reads
        events.progress("train", step, 3000, loss=0.1, eta_s=1.5, left_s=300.0)
    events.done("cancelled")
    events.close()
    assert lift.events_path.stat().st_size > 2 * MOST_BYTES
    followed = lifts.attach(lift.path)
    assert not followed.is_running and followed.was_cancelled and followed.can_be_resumed


def test_a_lift_is_cancelled_and_resumed_from_blender(lift: LiftFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    def command(python: Path, lift: Path, *, resume: bool) -> list[str | Path]:
        return [python, ENGINE, "long", lift, *(["--resume"] if resume else [])]

    def reaches(followed: lifts.Lift, step: int) -> bool:
        registry.poll_all(SCENE)
        return followed.progress.step > step

    monkeypatch.setattr(lifts, "engine_command", command)
    followed = lifts.start(lift, PYTHON)
    assert registry.running(lifts.Lift) == [followed] and lifts.lift_of(lift.path) is followed
    wait_until(lambda: reaches(followed, 5), lift.path)
    followed.cancel()
    registry.wait_for(followed, SCENE)
    assert followed.was_cancelled and followed.can_be_resumed and followed.error is None
    assert not registry.running(lifts.Lift)
    reached = followed.progress.step
    again = lifts.start(lift, PYTHON, resume=True)
    wait_until(lambda: reaches(again, 0), lift.path)
    assert again.progress.step > reached - 2, "it went on where it was"


def test_opening_a_folder_that_is_no_lift_is_refused(tmp_path: Path) -> None:
    assert lifts.look_at(tmp_path / "nothing") is None and tmp_path / "nothing" not in lifts.refusals
    (tmp_path / "folder").mkdir()
    assert lifts.look_at(tmp_path / "folder") is None
    assert lifts.refusals[tmp_path / "folder"].key == "not-lift-folder"


def test_a_lift_that_never_started_can_be_resumed(lift: LiftFolder) -> None:
    followed = lifts.attach(lift.path)
    assert followed.lift_state is LiftState.NOT_STARTED and followed.can_be_resumed and not followed.is_running


def test_a_running_lift_whose_events_become_unreadable_ends_with_an_error(lift: LiftFolder) -> None:
    with lift.lock():
        followed = lifts.attach(lift.path)
        assert followed.is_running
    lift.events_path.unlink()
    lift.events_path.mkdir()
    assert followed.poll(SCENE) and not followed.is_running
    assert followed.error.key == "unfollowed"
