"""How files are known again."""

from __future__ import annotations

from pathlib import Path

from engine.scene import digests_of_files


def test_what_cannot_be_read_is_not_known(tmp_path: Path) -> None:
    photo, depth = tmp_path / "photo", tmp_path / "depth"
    photo.write_bytes(b"photo")
    whole, alone, gone, folder = digests_of_files([(photo, photo), (photo, None), (photo, depth), (tmp_path, None)])
    assert whole and alone and whole != alone and gone == folder == ""
    photo.write_bytes(b"another")
    assert digests_of_files([(photo, None)]) != [alone]
