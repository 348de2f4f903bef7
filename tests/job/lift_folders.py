"""What the tests of lift folders share."""

from __future__ import annotations

from pathlib import Path

from engine.job import EventWriter, LiftFolder, LiftRequest, StopSignal, write_atomically, write_manifest


def new_lift(tmp_path: Path, name: str = "lift") -> LiftFolder:
    """A folder that asks for a lift of a scene that need not be there."""
    return LiftFolder.create(tmp_path / name, LiftRequest(scene=tmp_path / "scene"))


def tiny_lift(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
    """A lift that is over at once."""
    events.stage("train", 1, 1, "Training")
    stop.check()
    events.progress("train", 1, 1, loss=0.5, eta_s=0.0)
    write_atomically(folder.result_path / "metrics.json", '{"format": 1, "test_frames": [], "tables": []}')
    write_manifest(folder.result_path, versions={}, seed=folder.request.seed, settings={}, timings={"train": 0.0})
