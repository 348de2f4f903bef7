"""What a piece says of a worker that cannot do it."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from engine.batch.piece import Ended, Kind, Piece, do, engine_tag
from engine.errors import ErrorCode, PlgsError
from engine.job import LiftRequest


@pytest.mark.parametrize("kind", [Kind.LIFT, Kind.EXPORT, Kind.SCORE])
def test_a_scene_that_is_not_mounted_is_for_another_worker(kind: Kind, tmp_path: Path) -> None:
    piece = Piece(kind, "room", tmp_path, LiftRequest(scene=tmp_path / "unmounted"), engine_tag(), ("ply",))
    outcome = do(piece, lambda progress: None)
    assert outcome.ended is Ended.ELSEWHERE and "unmounted" in outcome.reason


def test_an_error_crosses_processes() -> None:
    error = PlgsError("is dark", "room", "Add light.", code=ErrorCode.NO_MASKS, option="--masks")
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error) and vars(again) == vars(error)
