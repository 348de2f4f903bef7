"""events.jsonl: one whole line after another, across kills."""

import errno
import json
import os
import sys
import threading
from pathlib import Path
from unittest.mock import Mock

import pytest

from engine.errors import PlgsError
from engine.job import EventReader, EventWriter, LiftFolder, LiftState, last_run
from engine.job.events import MOST_BYTES, TAIL_BYTES, last_events
from engine.job.follower import TaskFollower
from engine.job.lock import FileLock
from engine.job.task import LOG_BYTES, TaskState, last_lines
from tests.job.following import Start, bytes_read, follow, new_lift, watch

posix = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


def lines(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def test_events_match_the_documented_format(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    writer = EventWriter(path)
    writer.hello(threads=2, resumed=False)
    writer.stage("train", 2, 3, "Training")
    writer.progress("train", 5, 10, loss=float("nan"), eta_s=1.5, left_s=9.0)
    writer.metric("lifted", {"miou": 0.5, "psnr": float("inf")})
    writer.preview(tmp_path / "result" / "previews" / "a.png")
    writer.artifact(Path("/elsewhere/b.exr"), "pass")
    writer.warning("dark")
    writer.error(PlgsError("made-up", "is bad", tmp_path, "Mend it."))
    writer.done("finished")
    written = lines(path)
    assert [entry.pop("seq") for entry in written] == list(range(1, 10))
    assert all(isinstance(entry.pop("time"), float) for entry in written)
    assert set(written[0]) == {"event", "task", "engine_version", "pid", "machine", "python", "threads", "resumed"}
    assert written[1] == {"event": "stage", "name": "train", "index": 2, "count": 3, "label": "Training"}
    progress = {"stage": "train", "step": 5, "steps": 10, "loss": None, "eta_s": 1.5, "left_s": 9.0}
    assert written[2] == {"event": "progress", **progress}
    assert written[3] == {"event": "metric", "name": "lifted", "values": {"miou": 0.5, "psnr": None}}
    assert written[4] == {"event": "preview", "path": "result/previews/a.png"}
    assert written[5] == {"event": "artifact", "path": "/elsewhere/b.exr", "kind": "pass"}
    error = {"key": "made-up", "what": "is bad", "where": str(tmp_path), "fix": "Mend it."}
    assert written[7] == {"event": "error", **error, "code": "bad-input", "option": "", "exit_code": 2}
    assert written[8]["event"] == "done" and written[8]["state"] == "finished"


@pytest.mark.parametrize("torn", [b'{"seq": 3, "time": 1.0, "ev', b"\0\0\0\0", b'{"seq":3,"time":1.0,"event":"done"}'])
def test_events_continue_after_a_line_that_was_cut_off(tmp_path: Path, torn: bytes) -> None:
    path = tmp_path / "events.jsonl"
    first = EventWriter(path)
    first.warning("one")
    first.warning("two")
    first.close()
    with path.open("ab") as file:
        file.write(torn)
    reader = EventReader(path)
    assert [event.seq for event in reader.poll()] == [1, 2]
    second = EventWriter(path)
    second.warning("a longer line than the torn one, so that a wrong position would show at once")
    assert [entry["seq"] for entry in lines(path)] == [1, 2, 3]
    assert [event.seq for event in reader.poll()] == [3]


def test_each_line_of_the_events_is_read_once(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    source = tmp_path / "source.jsonl"
    writer = EventWriter(source)
    for number in range(5):
        writer.warning(f"number {number} – ü")
    reader, seen = EventReader(path), []
    assert reader.poll() == []
    with path.open("ab", buffering=0) as file:
        for byte in source.read_bytes():
            file.write(bytes([byte]))
            seen += [event.seq for event in reader.poll()]
    assert seen == [1, 2, 3, 4, 5]


def test_unknown_events_are_skipped(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    path.write_text(
        '{"seq":1,"time":0,"event":"warning","message":"a"}\nnonsense\n[1]\n{"seq":2}\n'
        '{"seq":3,"time":0,"event":"fanfare"}\n{"seq":4,"time":0,"event":"warning","message":"b"}\n'
    )
    assert [event.data["message"] for event in EventReader(path).poll()] == ["a", "b"]
    writer = EventWriter(path)
    writer.warning("c")
    assert json.loads(path.read_text().splitlines()[-1])["seq"] == 5


def test_no_event_is_written_after_the_event_done(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    writer = EventWriter(path)
    writer.done("cancelled")
    writer.done("finished")
    writer.warning("late")
    assert [entry.get("state") for entry in lines(path)] == ["cancelled"]


def test_two_threads_never_mix_their_lines_in_the_events(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    writer = EventWriter(path)
    threads = [
        threading.Thread(target=lambda: [writer.progress("train", step, 200) for step in range(200)]) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [entry["seq"] for entry in lines(path)] == list(range(1, 801))


def test_events_of_the_last_run_begin_with_its_hello(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    writer = EventWriter(path)
    writer.hello(threads=1, resumed=False)
    writer.warning("one")
    writer.hello(threads=1, resumed=True)
    writer.warning("two")
    assert [event.seq for event in last_run(path)] == [3, 4]
    assert last_run(tmp_path / "missing") == []


def a_long_run(path: Path) -> EventWriter:
    """A run whose hello lies far above the end of the file."""
    writer = EventWriter(path)
    writer.hello(threads=1, resumed=False)
    for step in range(4000):
        writer.progress("train", step, 4000, loss=0.5, eta_s=1.0)
        if step % 100 == 0:
            writer.warning(f"step {step}")
    assert path.stat().st_size > 2 * max(MOST_BYTES, TAIL_BYTES)
    return writer


def test_a_hurried_reader_skips_old_progress_and_keeps_every_warning(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    writer = a_long_run(path)
    reader, polls, seen = EventReader(path, hurried=True), 0, []
    while not polls or reader.is_behind:
        events = reader.poll()
        assert len(events) < 100
        seen += events
        polls += 1
    assert polls > 2 and [event.kind for event in seen].count("warning") == 40
    assert seen[-1].data["step"] == 3999
    assert reader.poll() == [] and not reader.is_behind
    writer.progress("train", 4000, 4000)
    assert [event.data["step"] for event in reader.poll()] == [4000]


def test_reading_the_last_events_reads_only_the_end_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    assert last_events(path) == []
    writer = a_long_run(path)
    writer.error(PlgsError("made-up", "broke", "here", "Mend it."))
    assert last_events(path)[-1].kind == "error" and len(last_events(path)) < 200
    writer.hello(threads=1, resumed=True)
    writer.warning("again")
    assert [event.kind for event in last_events(path)] == ["hello", "warning"]
    with path.open("ab") as file:
        file.write(b"\0" * 2 * TAIL_BYTES)  # a power cut
    assert [event.kind for event in last_events(path)] == ["hello", "warning"]
    reader = EventReader(path, from_end=True)
    EventWriter(path).warning("after the power came back")
    assert [event.data["message"] for event in reader.poll()] == ["after the power came back"]


@pytest.mark.parametrize(
    "line",
    [
        '{"seq": 1, "time": 0, "event": "stage", "name": "x"}',
        '{"seq": 1, "time": 0, "event": "error"}',
        '{"seq": 1e999, "time": 0, "event": "warning", "message": "x"}',
        '{"seq": 1, "time": 1%s, "event": "warning", "message": "x"}' % ("0" * 400),
        '{{"seq": 1, "time": 0, "event": "warning", "message": {}1{}}}'.format("[" * 100_000, "]" * 100_000),
    ],
    ids=["no label", "no words", "infinite", "huge", "deep"],
)
def test_malformed_events_are_dropped(tmp_path: Path, line: str) -> None:
    path = tmp_path / "events.jsonl"
    path.write_text(line + '\n{"seq": 2, "time": 0, "event": "warning", "message": "good"}\n')
    assert [event.data["message"] for event in EventReader(path).poll()] == ["good"]
    assert [event.seq for event in last_events(path)] == [2]
    EventWriter(path).warning("goes on")


def test_a_huge_events_file_without_lines_is_not_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    with path.open("wb") as file:
        file.truncate(1 << 32)
    before = bytes_read()
    assert last_events(path) == [] and last_run(path) == []
    reader = EventReader(path, from_end=True)
    writer = EventWriter(path)
    writer.warning("goes on")
    assert path.stat().st_size > 1 << 32
    assert [event.data["message"] for event in reader.poll()] == ["goes on"]
    assert bytes_read() - before < 100 << 20


def test_events_with_text_that_is_not_utf8_are_written_and_read(tmp_path: Path) -> None:
    writer = EventWriter(tmp_path / "events.jsonl")
    writer.warning("b\udce9d")
    assert [event.data["message"] for event in EventReader(tmp_path / "events.jsonl").poll()] == ["b\udce9d"]


@posix
@pytest.mark.parametrize(
    ("said", "state"), [("finished", TaskState.FINISHED), ("cancelled", TaskState.CANCELLED), (None, TaskState.FAILED)]
)
def test_a_failed_bake_leaves_the_lift_in_the_state_finished(
    folder: LiftFolder, start: Start, said: str | None, state: TaskState
) -> None:
    follow(start("short"))
    events = EventWriter(folder.events_path)
    events.hello(threads=1, resumed=False, task="bake")
    events.stage("bake", 1, 1, "Baking")
    if said is not None:
        events.done(said)
    events.close()
    watcher = watch(folder)
    follow(watcher)
    assert watcher.kind == "bake" and watcher.state is state
    assert folder.state() is LiftState.FINISHED


@posix
@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "1" + "0" * 400, '"x"', "null"])
def test_invalid_numbers_in_progress_events_are_ignored(folder: LiftFolder, number: str) -> None:
    line = f'{{"seq": 1, "time": 0, "event": "progress", "step": {number}, "steps": 9, "loss": 1, "eta_s": {number}}}'
    folder.events_path.write_text(line + "\n")
    watcher = watch(folder)
    watcher.poll()
    status = watcher.progress
    assert (status.step, status.steps, status.loss, status.eta_s) == (0, 9, 1.0, None)


@posix
@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE])
def test_following_survives_a_briefly_hung_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    folder, now = new_lift(tmp_path), [0.0]
    writer = EventWriter(folder.events_path)
    writer.hello(threads=1, resumed=False)
    watcher = TaskFollower(folder.task_files, lift=folder, clock=lambda: now[0])
    no_answer = Mock(side_effect=OSError(number, os.strerror(number)))
    with FileLock(folder.events_path):
        watcher.poll()
        writer.warning("goes on")
        for module in ("engine.job.lock", "engine.job.events"):
            with monkeypatch.context() as patch:
                patch.setattr(f"{module}.open_plain", no_answer)
                now[0] += 4.0
                assert not watcher.poll() and watcher.is_running
        now[0] += 100.0
        assert watcher.poll() and watcher.progress.warnings == ["goes on"] and watcher.is_running
        monkeypatch.setattr("engine.job.events.open_plain", no_answer)
        assert not watcher.poll()
        now[0] += 100.0
        assert watcher.poll() and watcher.state is TaskState.FAILED
        assert watcher.error.key == "unfollowed"


def test_the_last_lines_of_a_log_skip_blank_lines(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    log.write_bytes(b"one\n\ntwo \r\n  three\n\xff four\n\n")
    assert last_lines(log, 3) == ("two", "  three", "\N{REPLACEMENT CHARACTER} four")
    assert last_lines(log) == ("one", *last_lines(log, 3))
    assert last_lines(tmp_path / "missing") == ()


def test_reading_the_last_lines_of_a_log_reads_only_its_end(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    with log.open("wb") as file:
        file.truncate(1 << 30)  # sparse: takes no room
        file.seek(0, 2)
        file.write(b"\n" + b"x" * 5000 + b"\nthe end\n")
    before = bytes_read()
    *_, long, end = last_lines(log)
    assert bytes_read() - before < 2 * LOG_BYTES
    assert long == "x" * 500 and end == "the end"
