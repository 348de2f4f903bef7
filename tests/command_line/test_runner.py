"""Commands as tasks: the same events whatever the command, its answer among them, and one way to end."""

from __future__ import annotations

import errno
import io
import json
import os
import sys
from pathlib import Path

import pytest

from engine.command_line.main import main
from engine.command_line.runner import Command, output_to, run_at, run_in_terminal
from engine.errors import ErrorCode, PlgsError
from engine.job import EventWriter, ExitCode, StopSignal, last_run, write_atomically
from engine.job.follower import TaskFollower
from engine.job.lock import FileLock
from engine.job.process import engine_call
from engine.job.task import TaskPlace, TaskState
from tests.job.following import follow
from tests.tiny_scene import write_tiny_scene


def followed(place: TaskPlace, *arguments: str | Path) -> TaskFollower:
    """The command in a process of its own, followed to its end."""
    command = [*engine_call(Path(sys.executable)), *arguments]
    follower = TaskFollower.start(command, place, kind=str(arguments[0]))
    follow(follower)
    return follower


def test_any_command_is_followed_to_its_answer(tmp_path: Path) -> None:
    room, place = write_tiny_scene(tmp_path / "room", frames=9), TaskPlace.temporary(tmp_path)
    inspected = followed(place, "inspect", room)
    assert inspected.state is TaskState.FINISHED and inspected.kind == "inspect" and inspected.error is None
    assert inspected.answer is not None and inspected.answer["test_frames"] == 1
    assert "diagnosis" in inspected.answer and inspected.progress.stage == "diagnose"
    kinds = [event.kind for event in last_run(place.events)]
    assert kinds == ["hello", "stage", "stage", "answer", "done"]
    frames = followed(place, "frames", room, "-o", tmp_path / "out", "--make", "depth")
    assert frames.state is TaskState.FINISHED and frames.answer is not None and frames.answer["frames"] == 9
    assert (frames.progress.step, frames.progress.steps) == (9, 9)
    for follower in (inspected, frames):
        follower.close()
    assert place.folder is not None and not place.folder.exists()


def test_an_error_gives_its_code_and_the_option_that_fixes_it(tmp_path: Path) -> None:
    room, place = write_tiny_scene(tmp_path / "room", frames=3), TaskPlace.temporary(tmp_path)
    (room / "panoptic.json").rename(tmp_path / "masks.json")
    (room / "panoptic").rename(tmp_path / "masks")
    failed = followed(place, "frames", room, "-o", tmp_path / "out", "--make", "masks")
    assert failed.state is TaskState.FAILED and failed.error is not None and failed.answer is None
    assert (failed.error.code, failed.error.option) == (ErrorCode.BAD_INPUT, "--masks --depth")
    assert all(option in failed.error.fix for option in failed.error.option.split())
    assert failed.exit_code is ExitCode.BAD_INPUT


def test_an_error_of_several_lines_is_cut_to_one_and_the_log_has_the_rest(tmp_path: Path) -> None:
    place, terminal = TaskPlace.at(tmp_path / "events.jsonl"), io.StringIO()

    def work(events: EventWriter, stop: StopSignal) -> None:
        try:
            raise ValueError("Error(s) in loading\n\tsize mismatch for one\n\tsize mismatch for two")
        except ValueError as error:
            raise PlgsError(f"the model cannot be read ({error})", "model.pt", "Lift again.") from error

    with FileLock(place.events), output_to(place.log):
        assert run_at(Command("lift", work), place, terminal) is ExitCode.BAD_INPUT
    assert terminal.getvalue().count("\n") == 1 and "the model cannot be read" in terminal.getvalue()
    assert "\tsize mismatch for two" in place.log.read_text() and "Traceback" in place.log.read_text()


def test_a_cancelled_command_says_so(tmp_path: Path) -> None:
    room, place = write_tiny_scene(tmp_path / "room", frames=40), TaskPlace.temporary(tmp_path)
    command = [*engine_call(Path(sys.executable)), "frames", room, "-o", tmp_path / "out"]
    follower = TaskFollower.start(command, place, kind="frames")
    follower.cancel()
    follow(follower)
    assert follower.state is TaskState.CANCELLED and follower.error is None


def test_only_one_process_at_a_time_uses_a_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = TaskPlace.at(tmp_path / "events.jsonl")
    with FileLock(place.events):
        assert main(["handshake", "--events", str(place.events)]) == ExitCode.BUSY
    assert "at work" in capsys.readouterr().err
    assert main(["handshake", "--events", str(place.events)]) == 0
    (answer,) = (event.data["answer"] for event in last_run(place.events) if event.kind == "answer")
    assert isinstance(answer, dict) and answer["python"] == sys.version.split()[0]
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["events.json", "missing/events.jsonl"])
def test_events_go_only_where_events_can_be(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["handshake", "--events", str(tmp_path / name)]) == 2
    assert "--events" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_without_events_the_answer_is_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    room = write_tiny_scene(tmp_path / "room", frames=3)
    call = ["frames", str(room), "-o", str(tmp_path / "out"), "--make", "depth"]
    assert main(call) == 0
    said = capfd.readouterr()
    assert said.out == f"3 frames in {tmp_path / 'out'}\n" and "Making frames  3/3" in said.err
    assert main([*call, "--json"]) == 0
    assert json.loads(capfd.readouterr().out) == {"folder": str(tmp_path / "out"), "frames": 3}


@pytest.mark.parametrize(
    ("number", "code", "told"),
    [
        (errno.EIO, ExitCode.BAD_INPUT, "error: this cannot be used (Input/output error): {file}. Fix this, "),
        (errno.EDQUOT, ExitCode.INTERNAL_ERROR, "error: the disk is full: {file}. Make room there, "),
    ],
)
def test_a_disk_that_fails_as_a_file_is_flushed_is_a_line_that_names_the_file(
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    code: ExitCode,
    told: str,
) -> None:
    """The system's call knows no name, as it has a descriptor."""

    def fail(descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    file = tmp_path / "file"
    assert run_in_terminal(Command("export", lambda events, stop: write_atomically(file, "text"))) is code
    said = capfd.readouterr().err
    assert said.startswith(told.format(file=file)) and said.count("\n") == 1 and not file.exists()


def test_an_error_message_omits_empty_parts() -> None:
    assert str(PlgsError("no engine", "", "")) == "no engine"
    assert PlgsError("a", "b", "c", code=ErrorCode.BUSY).exit_code is ExitCode.BUSY
