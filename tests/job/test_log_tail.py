"""The end of a log, however long the log is."""

from __future__ import annotations

from pathlib import Path

from engine.job.task import LOG_BYTES, last_lines
from tests.job.bytes_read import bytes_read


def test_the_last_lines_that_say_something(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    log.write_bytes(b"one\n\ntwo \r\n  three\n\xff four\n\n")
    assert last_lines(log, 3) == ("two", "  three", "\N{REPLACEMENT CHARACTER} four")
    assert last_lines(log) == ("one", *last_lines(log, 3))
    assert last_lines(tmp_path / "missing") == ()


def test_a_huge_log_is_not_read_whole(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    with log.open("wb") as file:
        file.truncate(1 << 30)  # sparse: takes no room
        file.seek(0, 2)
        file.write(b"\n" + b"x" * 5000 + b"\nthe end\n")
    before = bytes_read()
    *_, long, end = last_lines(log)
    assert bytes_read() - before < 2 * LOG_BYTES
    assert long == "x" * 500 and end == "the end"
