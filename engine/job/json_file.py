"""JSON in and out, strictly: what is written any JSON reader can read, what is read is an object."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from numbers import Integral, Real
from pathlib import Path

from ..gates import read_plain
from .errors import JobError

MOST_BYTES = 1 << 26
"""Of a file: parsed, it takes some twenty times as much memory."""
Json = None | bool | int | float | str | list["Json"] | dict[str, "Json"]


def plain(value: object) -> Json:
    """The value in JSON's own types: numpy's numbers become Python's, paths text, NaN and infinity null.

    Raises TypeError for what has no place in JSON.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, os.PathLike):
        return Path(value).as_posix()
    if isinstance(value, Integral):
        return int(value)
    if isinstance(value, Real):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def to_line(value: Mapping[str, object]) -> bytes:
    """The object as one line of UTF-8 with its newline; what no UTF-8 can hold (of broken paths) is escaped."""
    return (json.dumps(plain(value), ensure_ascii=False, allow_nan=False) + "\n").encode(errors="backslashreplace")


def to_text(value: Mapping[str, object]) -> str:
    """The object as indented text."""
    return json.dumps(plain(value), ensure_ascii=False, allow_nan=False, indent=1) + "\n"


def read_object(path: Path, fix: str) -> dict[str, Json]:
    """The JSON object in a file. Raises JobError, with ``fix`` as the advice, when there is none."""
    value = read_value(path, fix)
    if not isinstance(value, dict):
        raise JobError("does not hold a JSON object", path, fix)
    return value


def read_value(path: Path, fix: str) -> Json:
    """What JSON a file holds. Raises JobError, with ``fix`` as the advice, when there is none."""
    try:
        value: Json = json.loads(read_plain(path, MOST_BYTES))
    except OSError as error:
        raise JobError(f"cannot be read ({error.strerror})", path, fix) from error
    except (RecursionError, MemoryError) as error:
        raise JobError("is nested too deeply, or too large", path, fix) from error
    except ValueError as error:  # covers broken JSON and broken UTF-8
        raise JobError(f"is not JSON ({error})", path, fix) from error
    return value
