"""One run of the engine, in this process: where output goes and how it ends."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest

from engine.command_line import runner
from engine.command_line.run_engine import run_engine
from engine.errors import PlgsError
from engine.job import EventWriter, ExitCode, LiftFolder, LiftState, StopSignal, add_files, last_run, write_atomically
from tests.job.lift_folders import new_lift, tiny_lift


def raising(error: BaseException) -> object:
    """A lift that fails like this."""

    def lift(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
        raise error

    return lift


def test_a_lift_that_works(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = new_lift(tmp_path)

    def talkative(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
        print("python out")
        print("python err", file=sys.stderr)
        os.write(1, b"native out\n")
        tiny_lift(folder, events, stop, resume=resume)

    assert run_engine(folder, lift=talkative) is ExitCode.FINISHED
    print("afterwards")
    assert capfd.readouterr() == ("afterwards\n", "")
    assert folder.state() is LiftState.FINISHED
    for line in ("python out", "python err", "native out"):
        assert line in folder.log_path.read_text()
    kinds = [event.kind for event in last_run(folder.events_path)]
    assert kinds == ["hello", "stage", "progress", "done"]


@pytest.mark.parametrize(
    ("error", "code", "told"),
    [
        (PlgsError("is 8-bit", "/a/depth.png", "Write 16 bits."), 2, "is 8-bit: /a/depth.png. Write 16 bits."),
        (PlgsError("is damaged", "/a", "Delete it."), 2, "is damaged: /a. Delete it."),
        (MemoryError(), 1, "memory ran out"),
        (ValueError("first line\nsecond"), 1, "ValueError: first line)"),
        (ModuleNotFoundError("No module named 'torch'"), 1, "make set-up"),
        (OSError(28, "No space left on device"), 1, "the disk is full"),
        (RuntimeError("I/O error: No space left on device (os error 28)"), 1, "the disk is full"),
        (RuntimeError("I/O error: File name too long (os error 36)"), 2, "this cannot be used (File name too long)"),
    ],
)
def test_a_lift_that_fails(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], error: Exception, code: int, told: str
) -> None:
    folder = new_lift(tmp_path)
    assert run_engine(folder, lift=raising(error)) == code  # type: ignore[arg-type]
    said = capfd.readouterr().err
    assert told in said and said.startswith("error: ") and said.count("\n") == 1
    assert folder.state() is LiftState.FAILED and folder.last_exit_code() == code
    assert ("Traceback" in folder.log_path.read_text()) != isinstance(error, PlgsError)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_log_without_room(tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    folder = new_lift(tmp_path)
    monkeypatch.setattr(runner, "open_to_append", lambda path: os.open("/dev/full", os.O_WRONLY))
    assert run_engine(folder, lift=raising(OSError(28, "No space left on device"))) == 1  # type: ignore[arg-type]
    said = capfd.readouterr().err
    assert said.startswith("error: the disk is full") and said.count("\n") == 1


def test_a_lift_without_a_manifest_is_not_a_success(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    assert run_engine(folder, lift=lambda folder, events, stop, *, resume: None) is ExitCode.INTERNAL_ERROR


def test_cancelled_before_it_began(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    folder.place.ask_to_cancel()
    assert run_engine(folder, lift=tiny_lift) is ExitCode.CANCELLED
    assert folder.state() is LiftState.CANCELLED
    assert run_engine(folder, resume=True, lift=tiny_lift) is ExitCode.FINISHED


def test_resume_starts_a_new_lift_and_leaves_a_finished_one(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = new_lift(tmp_path)
    assert run_engine(folder, resume=True, lift=tiny_lift) is ExitCode.FINISHED  # nothing to go on with: it starts
    before = folder.events_path.read_bytes()
    assert run_engine(folder, resume=True, lift=raising(ValueError())) is ExitCode.FINISHED  # type: ignore[arg-type]
    assert "finished already" in capfd.readouterr().out
    with pytest.raises(PlgsError, match="finished"):
        run_engine(folder, lift=tiny_lift)
    assert folder.events_path.read_bytes() == before


def test_a_broken_result_is_made_again(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    run_engine(folder, lift=tiny_lift)
    (folder.result_path / "metrics.json").unlink()
    assert folder.state() is LiftState.INTERRUPTED
    assert run_engine(folder, resume=True, lift=tiny_lift) is ExitCode.FINISHED
    assert folder.state() is LiftState.FINISHED


def test_a_corrupt_result_is_made_again(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    run_engine(folder, lift=tiny_lift)
    later, kept = folder.passes_path / "dolly.0001.exr", folder.passes_path / "dolly.0002.exr"
    for path in (later, kept):
        write_atomically(path, b"baked when the lift was finished")
    add_files(folder.result_path, [later, kept])
    for path in (folder.result_path / "metrics.json", later):
        path.write_bytes(path.read_bytes()[::-1])  # as long as before
    assert folder.state() is LiftState.FINISHED and not folder.is_whole()
    assert run_engine(folder, resume=True, lift=tiny_lift) is ExitCode.FINISHED
    assert folder.is_whole() and kept.exists()
    assert not later.exists(), "it is not listed as it is, but baked again when it is asked for"


def test_signals_are_given_back(tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGTERM)
    run_engine(new_lift(tmp_path), lift=tiny_lift)
    assert signal.getsignal(signal.SIGTERM) is before


def test_ctrl_c_has_its_own_code(tmp_path: Path) -> None:
    def interrupted(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        stop.check()

    folder = new_lift(tmp_path)
    assert run_engine(folder, lift=interrupted) is ExitCode.INTERRUPTED
    assert folder.state() is LiftState.CANCELLED
