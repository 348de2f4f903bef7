"""Lifts that this Blender follows, with a real engine process around a pretended lift."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from plgs.engine.job import ExitCode, JobError, LiftFolder, LiftRequest, LiftState
from plgs.plgs_blender.running import lifts

ENGINE = Path(__file__).resolve().parents[2] / "job" / "fake_engine.py"
PYTHON = Path(sys.executable)
Behaves = Callable[..., None]


@pytest.fixture(autouse=True)
def nothing_followed() -> Iterator[None]:
    yield
    lifts.let_go()


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


def poll_until(watch: lifts.Watch, condition: Callable[[], bool]) -> None:
    give_up = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < give_up, watch.status
        lifts.poll_all()
        time.sleep(0.01)


def test_a_lift_from_start_to_end(behaves: Behaves, lift: LiftFolder) -> None:
    behaves("short")
    watch = lifts.start(lift, PYTHON)
    assert watch.is_running and lifts.running() == [watch] and lifts.watch_of(lift.path) is watch
    assert lifts.wait_for(watch).code is ExitCode.FINISHED
    assert watch.is_finished and not watch.can_be_resumed and lifts.running() == []
    assert lifts.message_for(watch) == "The lift is finished"


def test_cancelled_and_resumed(behaves: Behaves, lift: LiftFolder) -> None:
    behaves("long")
    watch = lifts.start(lift, PYTHON)
    poll_until(watch, lambda: watch.status.step > 5)
    watch.follower.cancel()
    assert lifts.wait_for(watch).code is ExitCode.CANCELLED
    assert watch.can_be_resumed and watch.outcome is not None and watch.outcome.error is None
    reached = watch.status.step
    behaves("long")
    again = lifts.start(lift, PYTHON, resume=True)
    poll_until(again, lambda: again.status.step > 0)
    assert again.status.step > reached - 2, "it went on where it was"


@pytest.mark.parametrize("behaviour", ["broken", "memory", "segfault", "exits"])
def test_an_engine_that_dies_leaves_a_message(behaves: Behaves, lift: LiftFolder, behaviour: str) -> None:
    behaves(behaviour)
    watch = lifts.start(lift, PYTHON)
    outcome = lifts.wait_for(watch)
    assert outcome.code is ExitCode.INTERNAL_ERROR and outcome.error
    assert watch.can_be_resumed


def test_two_cannot_work_in_one_folder(behaves: Behaves, lift: LiftFolder) -> None:
    behaves("long")
    watch = lifts.start(lift, PYTHON)
    poll_until(watch, lambda: watch.status.step > 0)
    with pytest.raises(JobError, match="another engine"):
        lifts.start(lift, PYTHON)
    assert lifts.attach(lift.path) is watch


def test_another_blender_watches_and_cancels(behaves: Behaves, lift: LiftFolder) -> None:
    """Two followers of one folder, the second without a process, as in another Blender."""
    behaves("long")
    ours = lifts.start(lift, PYTHON)
    poll_until(ours, lambda: ours.status.step > 3)
    lifts._watches.clear()  # as if this were another process
    theirs = lifts.attach(lift.path)
    assert theirs is not ours and theirs.is_running
    poll_until(theirs, lambda: theirs.status.step > 3)
    theirs.follower.cancel()
    assert lifts.wait_for(theirs).code is ExitCode.CANCELLED
    assert theirs.state is LiftState.CANCELLED
    ours.follower.close()


def test_a_lift_that_goes_on_is_found_again(behaves: Behaves, lift: LiftFolder) -> None:
    behaves("long", "--go-on")
    watch = lifts.start(lift, PYTHON, keep_running=True)
    poll_until(watch, lambda: watch.status.step > 0)
    lifts.let_go()
    time.sleep(0.3)
    assert lift.is_running, "it outlives its Blender"
    again = lifts.look_at(lift.path)
    assert again is not None and again.is_running
    again.follower.cancel()
    assert lifts.wait_for(again).code is ExitCode.CANCELLED


def test_a_lift_that_shall_not_go_on_ends_with_its_blender(behaves: Behaves, lift: LiftFolder) -> None:
    behaves("long")
    watch = lifts.start(lift, PYTHON)
    poll_until(watch, lambda: watch.status.step > 0)
    lifts.let_go()
    give_up = time.monotonic() + 5.0
    while lift.is_running:
        assert time.monotonic() < give_up
        time.sleep(0.02)


def test_looking_at_what_is_no_lift(tmp_path: Path) -> None:
    assert lifts.look_at(tmp_path / "nothing") is None and lifts.refusal_of(tmp_path / "nothing") is None
    (tmp_path / "folder").mkdir()
    assert lifts.look_at(tmp_path / "folder") is None
    assert "is no lift folder" in str(lifts.refusal_of(tmp_path / "folder"))


def test_a_folder_that_was_not_started_can_be_resumed(lift: LiftFolder) -> None:
    watch = lifts.attach(lift.path)
    assert watch.state is LiftState.NOT_STARTED and watch.can_be_resumed and not watch.is_running


def test_the_folder_is_deleted_while_it_lifts(behaves: Behaves, lift: LiftFolder) -> None:
    behaves("long")
    watch = lifts.start(lift, PYTHON)
    poll_until(watch, lambda: watch.status.step > 0)
    watch.follower.kill()
    shutil.rmtree(lift.path)
    outcome = lifts.wait_for(watch)
    assert outcome.code is ExitCode.INTERNAL_ERROR and outcome.error
    assert "folder is gone" in lifts.message_for(watch)


def test_a_lift_that_can_no_longer_be_read_ends(lift: LiftFolder) -> None:
    with lift.lock():
        watch = lifts.attach(lift.path)
        assert watch.is_running
    lift.events_path.unlink()
    lift.events_path.mkdir()
    assert watch.poll() and not watch.is_running
    assert "can no longer be read" in lifts.message_for(watch)


@pytest.mark.parametrize("name", ["a" * 300, "a\0b", "a\ud800b"])
def test_looking_at_paths_that_cannot_be(tmp_path: Path, name: str) -> None:
    assert lifts.look_at(tmp_path / name) is None


def test_looking_at_a_lift_whose_events_are_a_folder(lift: LiftFolder) -> None:
    lift.events_path.mkdir()
    assert lifts.look_at(lift.path) is None
    assert "events.jsonl" in str(lifts.refusal_of(lift.path))
