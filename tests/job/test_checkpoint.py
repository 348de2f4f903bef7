"""checkpoint/: whole at every instant, whatever step of a save a kill hits."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from engine.errors import PlgsError
from engine.job import CheckpointStore


class Kill(BaseException):
    """What stands for SIGKILL in these tests: nothing in the code may catch it and tidy up after it."""


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


class Countdown:
    """Raises Kill in place of the n-th change to the file system, before or just after it."""

    def __init__(self, patch: pytest.MonkeyPatch, kill_at: int, after: bool) -> None:
        self.left, self.after = kill_at, after
        self.dead = False
        for owner, name in (
            (os, "rename"),
            (os, "replace"),
            (os, "unlink"),
            (os, "rmdir"),
            (os, "mkdir"),
            (os, "fsync"),
            (Path, "write_bytes"),
            (Path, "write_text"),
        ):
            patch.setattr(owner, name, self.wrap(getattr(owner, name)))

    def wrap(self, change: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*args: Any, **kwargs: Any) -> Any:
            if self.dead:
                raise Kill  # the dead change nothing, not even in `finally`
            self.left -= 1
            if self.left == 0:
                self.dead = True
                if self.after:
                    change(*args, **kwargs)
                raise Kill
            return change(*args, **kwargs)

        return counted


@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
def test_a_kill_at_any_change_leaves_a_whole_checkpoint(tmp_path: Path, after: bool) -> None:
    kills = 0
    for kill_at in range(1, 200):
        folder = tmp_path / str(kill_at)
        folder.mkdir()
        save(CheckpointStore(folder), 1)
        with pytest.MonkeyPatch.context() as patch:
            countdown = Countdown(patch, kill_at, after)
            try:
                save(CheckpointStore(folder), 2)
            except Kill:
                pass
        assert step_of(CheckpointStore(folder)) in (1, 2)
        save(CheckpointStore(folder), 3)  # and the next save mends everything
        assert step_of(CheckpointStore(folder)) == 3
        left = {path.name for path in folder.iterdir()}
        assert left <= {"checkpoint", ".part-doomed"}
        if not countdown.dead:
            break
        kills += 1
    assert kills > 10


def test_two_kills_in_a_row(tmp_path: Path) -> None:
    """The second save begins in what the first kill left, and is killed at every point as well."""
    for first in range(1, 26, 3):
        for second in range(1, 36, 6):
            folder = tmp_path / f"{first}-{second}"
            folder.mkdir()
            save(CheckpointStore(folder), 1)
            newest = 1
            for kill_at, step in ((first, 2), (second, 3)):
                with pytest.MonkeyPatch.context() as patch:
                    Countdown(patch, kill_at, after=True)
                    try:
                        save(CheckpointStore(folder), step)
                    except Kill:
                        pass
                found = step_of(CheckpointStore(folder))
                assert newest <= found <= step  # never back to an older one
                newest = found
            shutil.rmtree(folder)


def test_a_failing_writer_leaves_the_last_one(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path)
    save(store, 1)
    with pytest.raises(OSError, match="no space"):
        store.save({"step": 2}, lambda folder: (_ for _ in ()).throw(OSError("no space")))
    assert step_of(store) == 1


def test_falls_back_to_an_older_whole_one(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path)
    save(store, 1)
    shutil.copytree(tmp_path / "checkpoint", tmp_path / "checkpoint.old")
    (tmp_path / "checkpoint" / "model.bin").write_bytes(b"torn")
    checkpoint = store.latest()
    assert checkpoint is not None and checkpoint.path.name == "checkpoint.old"


@pytest.mark.parametrize("damage", ["changed", "missing", "no index", "format"])
def test_a_damaged_one_is_an_error_not_a_silent_new_start(tmp_path: Path, damage: str) -> None:
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
