"""What a piece says of a worker that cannot do it, and of other batches."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from engine.batch import piece
from engine.batch.piece import Ended, Kind, Piece, do, engine_tag
from engine.errors import ErrorCode, PlgsError
from engine.job import LiftFolder, LiftRequest
from engine.scene import open_scene
from engine.scene_of_lift import remember_scene
from tests.job.following import FAKE, command_after_another
from tests.tiny_scene import write_tiny_scene


@pytest.mark.parametrize("kind", [Kind.LIFT, Kind.EXPORT, Kind.SCORE])
def test_a_scene_that_is_not_mounted_is_for_another_worker(kind: Kind, tmp_path: Path) -> None:
    work = Piece(kind, "room", tmp_path, LiftRequest(scene=tmp_path / "unmounted"), engine_tag(), ("ply",))
    outcome = do(work, lambda progress: None)
    assert outcome.ended is Ended.ELSEWHERE and "unmounted" in outcome.reason


def test_a_lift_that_another_batch_does_before_this_engine_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(piece, "engine_command", command_after_another)
    (tmp_path / "room").mkdir()
    lift = Piece(Kind.LIFT, "room", tmp_path / "lift", LiftRequest(scene=tmp_path / "room"), engine_tag())
    outcome = do(lift, lambda progress: None)
    assert outcome.ended is Ended.DONE, outcome.reason


def test_a_lift_that_is_cancelled_while_its_engine_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By another batch: the engine deletes the cancel file, as it takes it for an earlier run's."""
    cancel = "import sys, runpy, pathlib; pathlib.Path(sys.argv[3], 'cancel').touch(); sys.argv = sys.argv[1:]"
    begin = f"{cancel}; runpy.run_path(sys.argv[0], run_name='__main__')"

    def command(python: Path, lift: Path, *, resume: bool) -> list[str | Path]:
        return [python, "-c", begin, FAKE, "patient", lift, *(["--resume"] if resume else [])]

    monkeypatch.setattr(piece, "engine_command", command)
    (tmp_path / "room").mkdir()
    lift = Piece(Kind.LIFT, "room", tmp_path / "lift", LiftRequest(scene=tmp_path / "room"), engine_tag())
    outcome = do(lift, lambda progress: None)
    assert outcome.ended is Ended.CANCELLED, outcome.reason


def test_a_finished_lift_is_lifted_again_when_its_masks_have_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = []

    def command(python: Path, lift: Path, *, resume: bool) -> list[str | Path]:
        started.append(lift)
        return [python, FAKE, "short", lift, *(["--resume"] if resume else [])]

    monkeypatch.setattr(piece, "engine_command", command)
    scene = write_tiny_scene(tmp_path / "room", frames=2)
    work = Piece(Kind.LIFT, "room", tmp_path / "lift", LiftRequest(scene=scene), engine_tag())
    assert do(work, lambda progress: None).ended is Ended.DONE
    remember_scene(LiftFolder.open(work.lift), open_scene(scene))
    assert do(work, lambda progress: None).ended is Ended.DONE and len(started) == 1
    write_tiny_scene(scene, frames=2, noise=0.5)
    assert do(work, lambda progress: None).ended is Ended.DONE and len(started) == 2


def test_an_error_crosses_processes() -> None:
    error = PlgsError("is dark", "room", "Add light.", code=ErrorCode.NO_MASKS, option="--masks")
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error) and vars(again) == vars(error)
