"""The folder checkpoint/: the latest complete state of a lift. After the first save, a kill always leaves one."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import PlgsError, reading
from ..json_file import Json
from ..records import read_record, record_text
from .atomic import PART, ListedFile, files_below, flush_to_disk

_INDEX = "state.json"
_FIX = "Delete the folders there whose names begin with 'checkpoint'; resume then starts from the beginning."


@dataclass(frozen=True)
class Checkpoint:
    """A complete state: ``state`` as it was given to `save`, and the folder with the files written with it."""

    path: Path
    state: Mapping[str, Json]


@dataclass(frozen=True)
class _Index:
    state: Mapping[str, Any]
    files: tuple[ListedFile, ...]


class CheckpointStore:
    """Saves and finds checkpoints in a lift folder. Only the holder of the folder's lock may save. A folder cannot
    replace another in one step on every system, so `save` takes three names: ``.part-checkpoint`` (being written) ->
    ``checkpoint.next`` (complete), then ``checkpoint`` -> ``checkpoint.old``, ``checkpoint.next`` -> ``checkpoint``.
    Whatever a kill leaves, the newest of next, checkpoint and old is complete."""

    def __init__(self, folder: Path, name: str = "checkpoint") -> None:
        self._part, self._next = folder / (PART + name), folder / f"{name}.next"
        self._current, self._old = folder / name, folder / f"{name}.old"

    def save(self, state: Mapping[str, object], write: Callable[[Path], object]) -> None:
        """Save a checkpoint: ``write`` puts its files into the folder that it is given; ``state`` must fit in JSON.
        Raises what ``write`` raises, and OSError; the previous checkpoint is then still there."""
        self._settle()
        self._part.mkdir()
        write(self._part)
        files = list(files_below(self._part))
        for path in files:
            flush_to_disk(path)
        index = _Index(state, tuple(ListedFile.of(path, self._part) for path in files))
        (self._part / _INDEX).write_text(record_text(index), encoding="utf-8")
        flush_to_disk(self._part / _INDEX)
        flush_to_disk(self._part)  # all before the rename, which makes it count as complete
        self._part.rename(self._next)
        self._advance()

    def latest(self) -> Checkpoint | None:
        """Return the newest complete checkpoint, checked against its checksums; None if none was saved. Raises
        PlgsError if there are checkpoints but no complete one, as on a failing disk."""
        damage: PlgsError | None = None
        for folder in (self._next, self._current, self._old):
            if folder.is_dir():
                try:
                    return Checkpoint(folder, _verified_state(folder))
                except PlgsError as error:
                    damage = damage or error  # the error of the newest one
        if damage is not None:
            raise damage
        return None

    @property
    def exists(self) -> bool:
        """Whether any checkpoint was saved, complete or not."""
        return any(folder.is_dir() for folder in (self._next, self._current, self._old))

    def _settle(self) -> None:
        """Finish what an earlier, killed `save` left undone."""
        _delete(self._part)
        if self._next.is_dir():
            self._advance()
        elif not self._current.is_dir() and self._old.is_dir():
            self._old.rename(self._current)
        _delete(self._old)

    def _advance(self) -> None:
        """Rename ``checkpoint.next`` to ``checkpoint``, and the one before to ``checkpoint.old``."""
        if self._current.is_dir():
            _delete(self._old)
            self._current.rename(self._old)
        self._next.rename(self._current)
        flush_to_disk(self._current.parent)
        _delete(self._old)


def _verified_state(folder: Path) -> Mapping[str, Json]:
    index = read_record(_Index, folder / _INDEX, _FIX)
    for listed in index.files:
        path = folder / listed.path
        is_whole = False
        # ValueError: a damaged index may name a file elsewhere.
        with suppress(ValueError), reading(path, "Check the disk, then resume again."):
            is_whole = path.is_file() and listed == ListedFile.of(path, folder)
        if not is_whole:
            raise PlgsError("checkpoint-damaged", "is damaged", folder, _FIX)
    return index.state


def _delete(folder: Path) -> None:
    """Remove a folder if it exists. It is renamed first, so that a kill midway leaves no half checkpoint."""
    if folder.is_dir():
        doomed = folder.with_name(PART + "doomed") if not folder.name.startswith(PART) else folder
        if doomed != folder:
            if doomed.is_dir():
                shutil.rmtree(doomed)
            folder.rename(doomed)
        shutil.rmtree(doomed)
