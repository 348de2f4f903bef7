"""Commands as tasks: the same events whatever the command, its answer among them, and one way to end."""

import errno
import io
import json
import os
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from engine.command_line import runner
from engine.command_line.main import main
from engine.command_line.run_engine import run_engine
from engine.command_line.runner import Command, output_to, run_at, run_in_terminal
from engine.errors import ErrorCode, PlgsError
from engine.job import EventWriter, ExitCode, LiftFolder, LiftState, StopSignal, add_files, last_run, write_atomically
from engine.job.follower import TaskFollower
from engine.job.lock import FileLock
from engine.job.process import engine_call
from engine.job.task import TaskFiles, TaskState
from tests.job.following import follow, new_lift, tiny_lift
from tests.raises_key import raises_key, worded
from tests.tiny_scene import write_tiny_scene


def followed(files: TaskFiles, *arguments: str | Path) -> TaskFollower:
    """The command in a process of its own, followed to its end."""
    command = [*engine_call(Path(sys.executable)), *arguments]
    follower = TaskFollower.start(command, files, kind=str(arguments[0]))
    follow(follower)
    return follower


def test_events_of_inspect_and_frames_end_with_their_answer(tmp_path: Path) -> None:
    room, files = write_tiny_scene(tmp_path / "room", frames=9), TaskFiles.temporary(tmp_path)
    inspected = followed(files, "inspect", room)
    assert inspected.state is TaskState.FINISHED and inspected.kind == "inspect" and inspected.error is None
    assert inspected.answer is not None and inspected.answer["test_frames"] == 1
    assert "diagnosis" in inspected.answer and inspected.progress.stage == "diagnose"
    kinds = [event.kind for event in last_run(files.events) if event.kind != "progress"]  # at most one a second
    assert kinds == ["hello", "stage", "stage", "answer", "done"]
    frames = followed(files, "frames", room, "-o", tmp_path / "out", "--make", "depth")
    assert frames.state is TaskState.FINISHED and frames.answer is not None and frames.answer["frames"] == 9
    assert (frames.progress.step, frames.progress.steps) == (100, 100)
    for follower in (inspected, frames):
        follower.close()
    assert files.folder is not None and not files.folder.exists()


def test_an_error_gives_its_code_and_the_option_that_fixes_it(tmp_path: Path) -> None:
    room, files = write_tiny_scene(tmp_path / "room", frames=3), TaskFiles.temporary(tmp_path)
    (room / "panoptic.json").rename(tmp_path / "masks.json")
    (room / "panoptic").rename(tmp_path / "masks")
    failed = followed(files, "frames", room, "-o", tmp_path / "out", "--make", "masks")
    assert failed.state is TaskState.FAILED and failed.error is not None and failed.answer is None
    assert (failed.error.code, failed.error.option) == (ErrorCode.BAD_INPUT, "--masks --depth")
    assert all(option in failed.error.fix for option in failed.error.option.split())
    assert failed.exit_code is ExitCode.BAD_INPUT


def test_an_error_of_several_lines_is_cut_to_one_and_the_log_has_the_rest(tmp_path: Path) -> None:
    files, terminal = TaskFiles.at(tmp_path / "events.jsonl"), io.StringIO()

    def work(events: EventWriter, stop: StopSignal) -> None:
        try:
            raise ValueError("Error(s) in loading\n\tsize mismatch for one\n\tsize mismatch for two")
        except ValueError as error:
            raise PlgsError("made-up", f"the model cannot be read ({error})", "model.pt", "Lift again.") from error

    with FileLock(files.events), output_to(files.log):
        assert run_at(Command("lift", work), files, terminal) is ExitCode.BAD_INPUT
    assert terminal.getvalue().count("\n") == 1 and "the model cannot be read" in terminal.getvalue()
    assert "\tsize mismatch for two" in files.log.read_text() and "Traceback" in files.log.read_text()


def test_a_cancelled_command_ends_in_the_state_cancelled(tmp_path: Path) -> None:
    room, files = write_tiny_scene(tmp_path / "room", frames=40), TaskFiles.temporary(tmp_path)
    command = [*engine_call(Path(sys.executable)), "frames", room, "-o", tmp_path / "out"]
    follower = TaskFollower.start(command, files, kind="frames")
    follower.cancel()
    follow(follower)
    assert follower.state is TaskState.CANCELLED and follower.error is None


def test_two_processes_cannot_write_the_same_events_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = TaskFiles.at(tmp_path / "events.jsonl")
    with FileLock(files.events):
        assert main(["handshake", "--events", str(files.events)]) == ExitCode.BUSY
    assert worded("at-work").search(capsys.readouterr().err)
    assert main(["handshake", "--events", str(files.events)]) == 0
    (answer,) = (event.data["answer"] for event in last_run(files.events) if event.kind == "answer")
    assert isinstance(answer, dict) and answer["python"] == sys.version.split()[0]
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["events.json", "missing/events.jsonl"])
def test_an_events_file_at_a_bad_path_is_refused(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["handshake", "--events", str(tmp_path / name)]) == 2
    assert "--events" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_command_without_an_events_file_prints_its_answer(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    room = write_tiny_scene(tmp_path / "room", frames=3)
    call = ["frames", str(room), "-o", str(tmp_path / "out"), "--make", "depth"]
    assert main(call) == 0
    said = capfd.readouterr()
    assert said.out == f"3 frames in {tmp_path / 'out'}\n" and "Making frames  100/100" in said.err
    assert main([*call, "--json"]) == 0
    assert json.loads(capfd.readouterr().out) == {"folder": str(tmp_path / "out"), "frames": 3}


@pytest.mark.parametrize(
    ("number", "code", "told"),
    [
        (errno.EIO, ExitCode.BAD_INPUT, "error: this cannot be used (Input/output error): {file}. Fix this, "),
        (errno.EDQUOT, ExitCode.INTERNAL_ERROR, "error: the disk is full: {file}. Make room there, "),
    ],
)
def test_a_disk_error_while_writing_gives_one_line_with_the_file_name(
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    code: ExitCode,
    told: str,
) -> None:
    """The system's call knows no name, as it has a descriptor."""
    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(number, os.strerror(number))))
    file = tmp_path / "file"
    assert run_in_terminal(Command("export", lambda events, stop: write_atomically(file, "text"))) is code
    said = capfd.readouterr().err
    assert said.startswith(told.format(file=file)) and said.count("\n") == 1 and not file.exists()


def raising(error: BaseException) -> object:
    """A lift that fails like this."""
    return Mock(side_effect=error)


def test_a_finished_lift_writes_its_events_log_and_manifest(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
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
        (
            PlgsError("made-up", "is 8-bit", "/a/depth.png", "Write 16 bits."),
            2,
            "/a/depth.png is 8-bit. Write 16 bits.",
        ),
        (PlgsError("made-up", "is damaged", "/a", "Delete it."), 2, "/a is damaged. Delete it."),
        (MemoryError(), 1, "memory ran out"),
        (ValueError("first line\nsecond"), 1, "ValueError: first line)"),
        (ModuleNotFoundError("No module named 'torch'"), 1, "make set-up"),
        (OSError(28, "No space left on device"), 1, "the disk is full"),
        (RuntimeError("I/O error: No space left on device (os error 28)"), 1, "the disk is full"),
        (RuntimeError('Failed to write to "/b/a.exr". No space left on device.'), 1, "the disk is full: /b/a.exr"),
        (PlgsError("made-up", "cannot be written (No space left on device)", "/a", "Use another."), 1, "Make room"),
        (OSError(27, "File too large", "a.npz"), 1, "a file is larger than the disk or the limit on files allows: a"),
        (RuntimeError('Failed to write to "a.exr". File too large.'), 1, "Raise the limit (ulimit -f), then "),
        (
            PlgsError("made-up", "cannot be written (File too large)", "/a", ""),
            1,
            "/a cannot be written (File too large). Raise the limit (ulimit -f), then ",
        ),
        (
            PlgsError("made-up", "cannot be written (File too large)", "/a", "Name another with -o.", option="-o"),
            1,
            "Or: Name another with -o.",
        ),
        (OSError(12, "Cannot allocate memory"), 1, "memory ran out"),
        (RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 9 bytes."), 1, "memory ran out"),
        (RuntimeError("I/O error: File name too long (os error 36)"), 2, "this cannot be used (File name too long)"),
    ],
)
def test_a_failed_lift_writes_its_error_to_the_events(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], error: Exception, code: int, told: str
) -> None:
    folder = new_lift(tmp_path)
    assert run_engine(folder, lift=raising(error)) == code  # type: ignore[arg-type]
    said = capfd.readouterr().err
    assert told in said and said.startswith("error: ") and said.count("\n") == 1
    assert folder.state() is LiftState.FAILED and folder.last_exit_code() == code
    assert ("Traceback" in folder.log_path.read_text()) != isinstance(error, PlgsError)


def test_an_error_on_a_full_disk_still_names_the_option_that_helps(tmp_path: Path) -> None:
    files = TaskFiles.at(tmp_path / "events.jsonl")
    error = PlgsError(
        "made-up", "cannot be written (No space left on device)", "/a", "Name another with -o.", option="-o"
    )
    with FileLock(files.events):
        run_at(Command("frames", raising(error)), files, io.StringIO())  # type: ignore[arg-type]
    (told,) = (event.data for event in last_run(files.events) if event.kind == "error")
    assert (told["code"], told["option"]) == (ErrorCode.DISK_FULL, "-o") and "-o" in str(told["fix"])


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_log_on_a_full_disk_gives_a_one_line_error(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = new_lift(tmp_path)
    monkeypatch.setattr(runner, "open_to_append", lambda path: os.open("/dev/full", os.O_WRONLY))
    assert run_engine(folder, lift=raising(OSError(28, "No space left on device"))) == 1  # type: ignore[arg-type]
    said = capfd.readouterr().err
    assert said.startswith("error: the disk is full") and said.count("\n") == 1


def test_a_lift_without_a_manifest_is_not_a_success(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    assert run_engine(folder, lift=lambda folder, events, stop, *, resume: None) is ExitCode.INTERNAL_ERROR


def test_a_lift_cancelled_before_its_start_can_be_resumed(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    folder.task_files.ask_to_cancel()
    assert run_engine(folder, lift=tiny_lift) is ExitCode.CANCELLED
    assert folder.state() is LiftState.CANCELLED
    assert run_engine(folder, resume=True, lift=tiny_lift) is ExitCode.FINISHED


def test_resume_starts_a_new_lift_and_keeps_a_finished_one(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = new_lift(tmp_path)
    assert run_engine(folder, resume=True, lift=tiny_lift) is ExitCode.FINISHED  # nothing to go on with: it starts
    before = folder.events_path.read_bytes()
    assert run_engine(folder, resume=True, lift=raising(ValueError())) is ExitCode.FINISHED  # type: ignore[arg-type]
    assert "finished already" in capfd.readouterr().out
    with raises_key("lift-begun"):
        run_engine(folder, lift=tiny_lift)
    assert folder.events_path.read_bytes() == before


def test_resume_makes_a_corrupt_result_again(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("is_terminal", [True, False])
def test_only_a_terminal_shows_the_progress_of_work_in_this_process(tmp_path: Path, is_terminal: bool) -> None:
    def work(events: EventWriter, stop: StopSignal) -> None:
        events.stage("train", 1, 2, "Training")
        events.progress("train", 3, 500)
        events.warning("dark")
        stop.ask("enough")
        stop.check()

    terminal = io.StringIO()
    terminal.isatty = lambda: is_terminal  # type: ignore[method-assign]
    run_at(Command("lift", work, when_stopped="Go on."), TaskFiles.at(tmp_path / "events.jsonl"), terminal)
    told = terminal.getvalue().replace("\r", "\n").splitlines()
    assert ("[1/2] Training  3/500" in {line.strip() for line in told}) == is_terminal
    assert "warning: dark" in told and any(line.startswith("Stopped: enough") for line in told)
