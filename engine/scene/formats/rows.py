"""Text files of rows: words between blanks, comments after ``#``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...json_file import LARGEST_TABLE
from ...posed.layout import read_text


@dataclass(frozen=True)
class Row:
    """A line's number and its words."""

    line: int
    words: list[str]


def read_rows(path: Path, fix: str, separator: str | None = None, titles: bool = False) -> Iterator[Row]:
    """The rows of a text file that are not empty, with its columns' ``titles`` if wanted.

    Raises PlgsError, with ``fix`` as the advice.
    """
    for number, line in enumerate(read_text(path, LARGEST_TABLE, fix).splitlines(), start=1):
        words = [word.strip() for word in line.partition("#")[0].split(separator)]
        # TUM's column titles are comments; some tools remove the #.
        if any(words) and (titles or words[0] != "timestamp"):
            yield Row(number, words)


def numbers(row: Row, path: Path, fix: str, count: int | None = None) -> NDArray[np.float64]:
    """A row's words as numbers, float64; they may be inf or NaN. Raises PlgsError unless there are ``count``."""
    try:
        values = np.array([float(word) for word in row.words])
    except ValueError as error:
        raise PlgsError(f"line {row.line} holds something other than numbers", path, fix) from error
    if count is not None and len(values) != count:
        raise PlgsError(f"line {row.line} holds {len(values)} numbers, not {count}", path, fix)
    return values


def matrix_rows(path: Path, fix: str) -> Iterator[NDArray[np.float64]]:
    """Matrices, float64 [4, 4], of a file with 16 (or, without the last row, 12) numbers per line. Raises PlgsError."""
    for row in read_rows(path, fix):
        values = numbers(row, path, fix)
        if len(values) not in (12, 16):
            raise PlgsError(f"line {row.line} holds {len(values)} numbers, not 16", path, fix)
        yield np.vstack([values.reshape(-1, 4)[:3], [0.0, 0.0, 0.0, 1.0]])
