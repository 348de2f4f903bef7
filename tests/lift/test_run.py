"""Which states of a trainer are stored."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from engine.job import Cancelled, EventWriter, LiftFolder, LiftRequest, StopSignal
from engine.lift import run
from engine.train.progress import StageReporter
from engine.train.trainer import StepReport


class Trainer:
    """Changes its state at the beginning of a step, and fails in the middle of the third as it is told to."""

    preset = type("Preset", (), {"steps": 5})

    def __init__(self, failure: Exception | None) -> None:
        self.failure, self.step_number, self.stored = failure, 0, -1

    @property
    def finished(self) -> bool:
        return self.step_number >= 5

    def step(self, check: object) -> StepReport:
        if self.step_number == 2 and isinstance(self.failure, Cancelled):
            raise self.failure
        self.step_number += 1
        if self.step_number == 3 and self.failure is not None:
            raise self.failure
        return StepReport(self.step_number, 1.0, 1.0, 0.0, 0.0, 1)


@pytest.fixture
def stages(tmp_path: Path) -> Iterator[StageReporter]:
    events = EventWriter(tmp_path / "events.jsonl")
    yield StageReporter(events, StopSignal(tmp_path / "cancel"), run.STAGES)
    events.close()


@pytest.mark.parametrize(
    ("failure", "every_s", "stored"),
    [
        (None, 1e9, 5),  # at the end
        (Cancelled("asked to"), 1e9, 2),  # when stopped
        (MemoryError(), -1.0, 2),  # now and then, and never half a step
        (MemoryError(), 1e9, -1),
    ],
)
def test_only_whole_states_are_stored(
    failure: Exception | None, every_s: float, stored: int, stages: StageReporter, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(run, "CHECKPOINT_EVERY_S", every_s)
    monkeypatch.setattr(run, "save_checkpoint", lambda trainer, folder: setattr(trainer, "stored", trainer.step_number))
    trainer, folder = Trainer(failure), LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path))
    if failure is None:
        run.train(trainer, folder, stages)  # type: ignore[arg-type]
    else:
        with pytest.raises(type(failure)):
            run.train(trainer, folder, stages)  # type: ignore[arg-type]
    assert trainer.stored == stored
