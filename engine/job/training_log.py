"""Write training.csv in the lift folder: the losses of every step."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from ..gates import open_to_append, read_plain
from .atomic import write_atomically

MOST_BYTES = 1 << 30
"""The most bytes of the file of an earlier run; a million steps have a tenth of that."""


class TrainingLog:
    """Adds a line for each step. A resumed run keeps the lines up to step ``done``. Raises OSError."""

    def __init__(self, path: Path, done: int) -> None:
        kept: list[str] = []
        if done:
            with suppress(FileNotFoundError):
                kept = read_plain(path, MOST_BYTES).decode("utf-8", "replace").splitlines()[: done + 1]  # + header
        write_atomically(path, "".join(f"{line}\n" for line in kept))
        self._file = os.fdopen(open_to_append(path), "a", encoding="utf-8", newline="", buffering=1)
        self._is_empty = not kept

    def add(self, numbers: Mapping[str, float]) -> None:
        """Write the numbers of a step under their names."""
        writer = csv.DictWriter(self._file, numbers, lineterminator="\n")
        if self._is_empty:
            writer.writeheader()
            self._is_empty = False
        writer.writerow({name: f"{value:.7g}" for name, value in numbers.items()})  # as precise as float32

    def close(self) -> None:
        self._file.close()
