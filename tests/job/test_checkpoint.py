"""checkpoint/: whole at every instant, whatever step of a save a kill hits."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from engine.errors import PlgsError
from engine.job import CheckpointStore


def save(store: CheckpointStore, step: int) -> None:
    def write(folder: Path) -> None:
        (folder / "model.bin").write_bytes(bytes([step]) * 100)
        (folder / "deep").mkdir()
        (folder / "deep" / "optimiser.bin").write_bytes(bytes([step]) * 50)

    store.save({"step": step}, write)


def step_of(store: CheckpointStore) -> int:
    """The step of the newest checkpoint, its files included; 0 when there is none."""
    checkpoint = store.latest()
    if checkpoint is None:
        return 0
    step = checkpoint.state["step"]
    assert isinstance(step, int)
    assert (checkpoint.path / "model.bin").read_bytes() == bytes([step]) * 100
    assert (checkpoint.path / "deep" / "optimiser.bin").read_bytes() == bytes([step]) * 50
    return step


def test_the_newest_counts(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path)
    assert store.latest() is None and not store.exists
    for step in (1, 2, 3):
        save(store, step)
        assert step_of(store) == step
        assert [path.name for path in tmp_path.iterdir()] == ["checkpoint"]


@pytest.fixture(autouse=True)
def _no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def test_a_failing_writer_leaves_the_last_checkpoint(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path)
    save(store, 1)
    with pytest.raises(OSError, match="no space"):
        store.save({"step": 2}, lambda folder: (_ for _ in ()).throw(OSError("no space")))
    assert step_of(store) == 1


def test_it_falls_back_to_an_older_complete_checkpoint(tmp_path: Path) -> None:
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
