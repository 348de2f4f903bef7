"""Files appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from engine.errors import ErrorCode, PlgsError
from engine.job import atomic, write_atomically
from engine.job.atomic import PART, files_below, remove_parts


def test_it_writes_bytes_text_and_by_function(tmp_path: Path) -> None:
    write_atomically(tmp_path / "deep" / "a.bin", b"\0\1")
    write_atomically(tmp_path / "b.txt", "für")
    write_atomically(tmp_path / "c.png", lambda path: path.write_bytes(path.suffix.encode()))
    assert (tmp_path / "deep" / "a.bin").read_bytes() == b"\0\1"
    assert (tmp_path / "b.txt").read_text(encoding="utf-8") == "für"
    assert (tmp_path / "c.png").read_bytes() == b".png"


def test_a_failing_writer_leaves_the_old_content(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_atomically(path, b"old")

    def fail(part: Path) -> None:
        part.write_bytes(b"half of the n")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, fail)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_writer_that_writes_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_atomically(tmp_path / "a.bin", lambda part: None)
    assert list(tmp_path.iterdir()) == []


def test_it_clears_leftovers_away(tmp_path: Path) -> None:
    (tmp_path / "deep" / (PART + "folder")).mkdir(parents=True)
    for path in (tmp_path / (PART + "x"), tmp_path / "deep" / (PART + "folder") / "y", tmp_path / "deep" / "kept"):
        path.write_bytes(b"")
    remove_parts(tmp_path)
    assert list(files_below(tmp_path)) == [tmp_path / "deep" / "kept"]
    assert not (tmp_path / "deep" / (PART + "folder")).exists()


def test_a_part_that_another_process_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    monkeypatch.setattr(atomic, "flush_to_disk", Path.unlink)
    with pytest.raises(PlgsError, match="another process took over") as met:
        write_atomically(path, "new")
    assert met.value.code is ErrorCode.BUSY and path.read_text() == "old"
