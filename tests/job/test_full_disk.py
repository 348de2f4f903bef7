"""A real file system of a few megabytes that fills up while it is written to, and is freed again."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from engine.command_line.run_engine import run_engine
from engine.job import EventWriter, ExitCode, LiftFolder, LiftRequest, LiftState, StopSignal, verify
from engine.job.events import last_events
from tests.job.lift_folders import tiny_lift

SIZE = 3 << 20
STEPS = 12


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """Mounted for this test. Only root may, and not in every container."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", str(folder)]
    if sys.platform != "linux" or subprocess.run(mount, capture_output=True, timeout=120).returncode != 0:
        pytest.skip("no file system can be mounted here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True, timeout=120)


def fill(disk: Path) -> Path:
    filler = disk / "filler"
    with pytest.raises(OSError), filler.open("wb", buffering=0) as file:
        while True:
            assert file.write(bytes(4096))
    return filler


def lift_until_full(disk: Path, at: int) -> object:
    """A lift of several checkpoints; at a step somebody else takes all room that is left."""

    def lift(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
        events.stage("train", 1, 1, "Training")
        checkpoint = folder.checkpoints.latest()
        for step in range(1 + (int(str(checkpoint.state["step"])) if checkpoint else 0), STEPS + 1):
            if step == at:
                fill(disk)
            folder.checkpoints.save({"step": step}, lambda into: (into / "model").write_bytes(bytes(300_000)))
            events.progress("train", step, STEPS)
        if at > STEPS:
            fill(disk)
        tiny_lift(folder, events, stop, resume=resume)

    return lift


@pytest.mark.parametrize("at", [1, 2, 7, STEPS, STEPS + 1])
def test_a_lift_continues_when_there_is_room_again(disk: Path, at: int, capfd: pytest.CaptureFixture[str]) -> None:
    folder = LiftFolder.create(disk / "lift", LiftRequest(scene=disk))
    code = run_engine(folder, lift=lift_until_full(disk, at))  # type: ignore[arg-type]
    said = capfd.readouterr().err
    assert code == ExitCode.INTERNAL_ERROR and said.startswith("error: the disk is full") and said.count("\n") == 1
    assert folder.state() in (LiftState.FAILED, LiftState.INTERRUPTED)
    assert all(event.kind in ("hello", "stage", "progress", "error") for event in last_events(folder.events_path))
    checkpoint = folder.checkpoints.latest()
    assert (0 if checkpoint is None else checkpoint.state["step"]) == min(at, STEPS + 1) - 1
    (disk / "filler").unlink()
    assert run_engine(folder, resume=True, lift=lift_until_full(disk, 0)) is ExitCode.FINISHED  # type: ignore[arg-type]
    assert folder.state() is LiftState.FINISHED and verify(folder.result_path)
