"""JSON that somebody else wrote: read it, and take typed values out of it with a clear line for what is wrong."""

from __future__ import annotations

import json
import unicodedata
from pathlib import Path, PureWindowsPath
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..gates import read_plain
from .frame import SceneError
from .layout import shown

MOST_BYTES = 1 << 28
"""Of a file; the longest recordings' tables are tenths of that."""


def read_json_object(path: Path) -> dict[str, Any]:
    """Read a file that holds one JSON object. Raises SceneError when it is missing, cut off or of another kind."""
    try:
        data = read_plain(path, MOST_BYTES)
    except OSError as error:
        raise SceneError(f"the file cannot be read ({error.strerror})", path, "Check that it exists.") from error
    return parse_json_object(data, path)


def parse_json_object(data: bytes, path: Path) -> dict[str, Any]:
    """``read_json_object`` for bytes that come out of the file ``path``. Raises SceneError."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError("this is not a JSON text", path, "Write it as UTF-8.") from error
    if not text.strip():
        raise SceneError("the JSON file is empty", path, "Write this file again.")
    try:
        content = json.loads(text, parse_constant=_refuse_constant)
    except json.JSONDecodeError as error:
        raise SceneError(
            f"the JSON is cut off or broken (line {error.lineno}: {error.msg})", path, "Write this file again."
        ) from error
    except (ValueError, RecursionError, MemoryError) as error:
        reason = str(error) or "no memory is left for it"
        raise SceneError(f"the JSON cannot be used ({reason})", path, "Write this file again.") from error
    if not isinstance(content, dict):
        raise SceneError(f"the file holds {kind_of(content)}, not an object", path, "Write it as {...}.")
    return content


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


def kind_of(value: object) -> str:
    """What JSON calls a value, for messages."""
    if value is None:
        return "null"
    names = {bool: "true or false", int: "a number", float: "a number", str: "a text", list: "a list"}
    return names.get(type(value), "an object")


def take_list(entry: dict[str, Any], key: str, context: str, path: Path) -> list[Any]:
    """``entry[key]`` as a list; ``context`` says whose key it is ("annotation 3"). Raises SceneError."""
    value = _take(entry, key, context, path)
    if not isinstance(value, list):
        raise wrong_type(key, "a list", value, context, path)
    return value


def take_objects(entry: dict[str, Any], key: str, context: str, path: Path) -> list[dict[str, Any]]:
    """``entry[key]`` as a list of objects. Raises SceneError."""
    value = take_list(entry, key, context, path)
    for item in value:
        if not isinstance(item, dict):
            raise wrong_type(key, "a list of objects", item, context, path)
    return value


def take_whole_number(entry: dict[str, Any], key: str, context: str, path: Path) -> int:
    """``entry[key]`` as a whole number (2 or 2.0, not true, not "2"). Raises SceneError."""
    value = _take(entry, key, context, path)
    whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if isinstance(value, bool) or not whole:
        raise wrong_type(key, "a whole number", value, context, path)
    return int(value)


def take_number(entry: dict[str, Any], key: str, context: str, path: Path) -> float:
    """``entry[key]`` as a finite number. Raises SceneError."""
    value = _take(entry, key, context, path)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        raise wrong_type(key, "a number", value, context, path)
    return float(value)


def take_matrix(
    entry: dict[str, Any], key: str, context: str, path: Path, shapes: tuple[tuple[int, int], ...]
) -> NDArray[np.float64]:
    """``entry[key]``, a list of rows, as a matrix of one of ``shapes``; it may hold inf. Raises SceneError."""
    value = take_list(entry, key, context, path)
    wanted = " or ".join(f"{rows}x{columns}" for rows, columns in shapes)
    try:
        matrix = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise wrong_type(key, f"{wanted} numbers", value, context, path) from error
    if matrix.shape not in shapes:
        raise wrong_type(key, f"{wanted} numbers", value, context, path)
    return matrix


def take_text(entry: dict[str, Any], key: str, context: str, path: Path) -> str:
    """``entry[key]`` as a text that is not empty. Raises SceneError."""
    value = _take(entry, key, context, path)
    if not isinstance(value, str) or not value:
        raise wrong_type(key, "a text", value, context, path)
    if any(unicodedata.category(character) in ("Cc", "Cs") for character in value):  # nothing could show or store it
        raise SceneError(f'"{key}" of {context} has characters that no name can have', path, "Correct the file.")
    return value


def take_flag(entry: dict[str, Any], key: str, context: str, path: Path) -> bool:
    """``entry[key]`` as true or false, also written 1 or 0. Raises SceneError."""
    value = _take(entry, key, context, path)
    if value not in (0, 1) or isinstance(value, float):
        raise wrong_type(key, "0 or 1", value, context, path)
    return bool(value)


def _take(entry: dict[str, Any], key: str, context: str, path: Path) -> Any:
    if key not in entry:
        raise SceneError(f'{context} has no "{key}"', path, "Add it.")
    return entry[key]


def wrong_type(key: str, wanted: str, value: object, context: str, path: Path) -> SceneError:
    """The error for a value of another kind than wanted."""
    shown = repr(value) if isinstance(value, bool | int | float | str) else kind_of(value)
    return SceneError(f'"{key}" of {context} must be {wanted}, not {shown[:60]}', path, "Correct the file.")


def file_inside(folder: Path, name: str, path: Path) -> Path:
    """The file ``name``, of which the JSON file ``path`` speaks, in ``folder``. Raises SceneError if it is outside."""
    # Windows' rules are the wider ones: drives, both kinds of slashes.
    parts = PureWindowsPath(name)
    if parts.anchor or ".." in parts.parts or "\0" in name or not parts.parts:
        raise SceneError(
            f'the file name "{shown(name)}" leaves the folder {folder.name}',
            path,
            "Use plain names of files in that folder.",
        )
    return folder.joinpath(*parts.parts)
