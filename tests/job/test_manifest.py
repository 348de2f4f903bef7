"""manifest.json: no manifest, no result; and nothing in the result can change unseen."""

import json
import os
import shutil
from pathlib import Path

import pytest

from engine.errors import ErrorCode, PlgsError
from engine.job import CheckpointStore, atomic, check_sizes, read_manifest, verify, write_atomically, write_manifest
from engine.job.atomic import PART, files_below, remove_parts
from tests.raises_key import raises_key


@pytest.fixture
def result(tmp_path: Path) -> Path:
    (tmp_path / "passes").mkdir()
    (tmp_path / "passes" / "0001.exr").write_bytes(b"pixels")
    (tmp_path / "anchors.npz").write_bytes(b"anchors")
    (tmp_path / ".part-anchors.npz").write_bytes(b"half")
    write_manifest(tmp_path, versions={"torch": "2"}, seed=7, settings={"steps": 3}, timings={"train": 1.5})
    return tmp_path


def test_a_manifest_lists_every_file_of_a_result(result: Path) -> None:
    manifest = verify(result)
    assert [(str(file.path), file.bytes) for file in manifest.files] == [("anchors.npz", 7), ("passes/0001.exr", 6)]
    assert manifest.seed == 7 and manifest.settings == {"steps": 3}
    assert manifest.versions == {"torch": "2"} and manifest.timings == {"train": 1.5}
    assert not (result / ".part-anchors.npz").exists()


def test_writing_a_manifest_again_gives_the_same_bytes(result: Path) -> None:
    before = (result / "manifest.json").read_bytes()
    write_manifest(result, versions={"torch": "2"}, seed=7, settings={"steps": 3}, timings={"train": 1.5})
    assert (result / "manifest.json").read_bytes() == before


def test_verifying_a_manifest_finds_changed_files(result: Path) -> None:
    (result / "anchors.npz").write_bytes(b"ANCHORS")
    check_sizes(result)
    with raises_key("file-changed anchors.npz"):
        verify(result)
    (result / "anchors.npz").write_bytes(b"anch")
    with raises_key("other-bytes"):
        check_sizes(result)
    (result / "anchors.npz").unlink()
    with raises_key("file-missing"):
        check_sizes(result)


def test_a_damaged_manifest_is_refused(result: Path) -> None:
    path = result / "manifest.json"
    whole = json.loads(path.read_text())
    for change in (
        {"format": 9},
        {"files": None},
        {"files": [{"path": "../secret", "bytes": 1, "sha256": ""}]},
        {"files": [{"path": "/secret", "bytes": 1, "sha256": ""}]},
        {"files": [{"path": "a"}]},
        {"seed": "seven"},
        {"timings": []},
    ):
        path.write_text(json.dumps(whole | change))
        with raises_key("* manifest.json"):
            read_manifest(result)
    for name in ("a\0b", "a\ud800b"):
        path.write_text(json.dumps(whole | {"files": [{"path": name, "bytes": 1, "sha256": ""}]}))
        with raises_key("* manifest.json"):
            check_sizes(result)
    path.write_text('{"format": ' + "[" * 100_000)
    with raises_key("json-deep manifest.json"):
        read_manifest(result)
    path.write_text("{")
    with raises_key("* manifest.json"):
        read_manifest(result)
    path.unlink()
    with raises_key("not-finished"):
        read_manifest(result)


def test_a_file_is_written_atomically_from_bytes_text_or_a_function(tmp_path: Path) -> None:
    write_atomically(tmp_path / "deep" / "a.bin", b"\0\1")
    write_atomically(tmp_path / "b.txt", "für")
    write_atomically(tmp_path / "c.png", lambda path: path.write_bytes(path.suffix.encode()))
    assert (tmp_path / "deep" / "a.bin").read_bytes() == b"\0\1"
    assert (tmp_path / "b.txt").read_text(encoding="utf-8") == "für"
    assert (tmp_path / "c.png").read_bytes() == b".png"


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_atomically(path, b"old")

    def fail(part: Path) -> None:
        part.write_bytes(b"half of the n")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, fail)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_unfinished_part_files_are_deleted(tmp_path: Path) -> None:
    (tmp_path / "deep" / (PART + "folder")).mkdir(parents=True)
    for path in (tmp_path / (PART + "x"), tmp_path / "deep" / (PART + "folder") / "y", tmp_path / "deep" / "kept"):
        path.write_bytes(b"")
    remove_parts(tmp_path)
    assert list(files_below(tmp_path)) == [tmp_path / "deep" / "kept"]
    assert not (tmp_path / "deep" / (PART + "folder")).exists()


def test_a_part_file_removed_by_another_process_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    monkeypatch.setattr(atomic, "flush_to_disk", Path.unlink)
    with raises_key("taken-over") as met:
        write_atomically(path, "new")
    assert met.value.code is ErrorCode.BUSY and path.read_text() == "old"


def save(store: CheckpointStore, step: int) -> None:
    def write(folder: Path) -> None:
        (folder / "model.bin").write_bytes(bytes([step]) * 100)
        (folder / "deep").mkdir()
        (folder / "deep" / "optimiser.bin").write_bytes(bytes([step]) * 50)

    store.save({"step": step}, write)


@pytest.fixture(autouse=True)
def _no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def test_an_incomplete_checkpoint_falls_back_to_the_one_before(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path)
    save(store, 1)
    shutil.copytree(tmp_path / "checkpoint", tmp_path / "checkpoint.old")
    (tmp_path / "checkpoint" / "model.bin").write_bytes(b"torn")
    checkpoint = store.latest()
    assert checkpoint is not None and checkpoint.path.name == "checkpoint.old"


@pytest.mark.parametrize("damage", ["changed", "missing", "no index", "format"])
def test_a_damaged_checkpoint_is_an_error_and_not_a_silent_restart(tmp_path: Path, damage: str) -> None:
    store = CheckpointStore(tmp_path)
    save(store, 1)
    model, index = tmp_path / "checkpoint" / "model.bin", tmp_path / "checkpoint" / "state.json"
    match damage:
        case "changed":
            model.write_bytes(b"\2" * 100)
        case "missing":
            model.unlink()
        case "no index":
            index.unlink()
        case "format":
            index.write_text(index.read_text().replace('"format": 1', '"format": 7'))
    with pytest.raises(PlgsError):
        store.latest()
    assert store.exists
