"""Read and write JSON strictly: any program can read the files, and every value is checked to have its type."""

from __future__ import annotations

import json
import math
import os
import re
import unicodedata
from collections.abc import Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NoReturn

from .errors import PlgsError, reading
from .gates import read_plain

MOST_BYTES = 1 << 26
"""Bytes: the largest file of ours that is read. Parsed, it takes some twenty times as much memory."""
LARGEST_TABLE = 1 << 28
"""Bytes: the largest table of another program that is read. Those of the longest recordings have a tenth of that."""
_WRITE_AGAIN = "Write this file again."
_LARGEST = 2**64 - 1  # the largest whole number in a file: ids made of hashes reach it
_LONG = re.compile(rb"\d{20}")  # only a number that is as long can be larger
Json = None | bool | int | float | str | list["Json"] | dict[str, "Json"]


def plain(value: object) -> Json:
    """Return the value in JSON's types: paths become text, NaN and infinity null. Raises TypeError for other types."""
    if value is None or isinstance(value, bool | str):  # before Integral, which bool is, too
        return value
    if isinstance(value, os.PathLike):
        return Path(value).as_posix()
    if isinstance(value, Integral):  # numpy's as well
        return int(value)
    if isinstance(value, Real):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def to_line(value: Mapping[str, object]) -> bytes:
    """Return the object as a line of JSON, UTF-8 with its newline. Characters of paths that UTF-8 lacks are escaped."""
    return (json.dumps(plain(value), ensure_ascii=False, allow_nan=False) + "\n").encode(errors="backslashreplace")


def to_text(value: Mapping[str, object]) -> str:
    """Return the object as indented JSON text."""
    return json.dumps(plain(value), ensure_ascii=False, allow_nan=False, indent=1) + "\n"


def read_value(path: Path, fix: str) -> Json:
    """Read the JSON value in a file of ours. Raises PlgsError with the advice ``fix`` if it is missing or broken."""
    with reading(path, fix):
        value: Json = _parsed(read_plain(path, MOST_BYTES), path, fix)
    return value


def read_object(path: Path, fix: str) -> dict[str, Json]:
    """Read the JSON object in a file of ours. Raises PlgsError with the advice ``fix`` if it is missing or broken."""
    return _object(read_value(path, fix), path, fix)


def read_json(path: Path) -> Any:
    """Read the JSON value in a file of another program. Raises PlgsError if it is missing, broken or too large."""
    with reading(path):
        return _parsed(read_plain(path, LARGEST_TABLE), path, _WRITE_AGAIN)


def read_json_object(path: Path) -> dict[str, Any]:
    """Read the JSON object in a file of another program. Raises PlgsError if it is missing, broken or no object."""
    return _object(read_json(path), path, "Write it as {...}.")


def parse_json_object(data: bytes, path: Path) -> dict[str, Any]:
    """Parse the JSON object in ``data``, bytes of the file ``path``. Raises PlgsError if it is broken or no object."""
    return _object(_parsed(data, path, _WRITE_AGAIN), path, "Write it as {...}.")


def _parsed(data: bytes, path: Path, fix: str) -> Any:
    try:
        text = data.decode("utf-8-sig")  # Windows' editors may write a byte order mark
    except UnicodeDecodeError as error:
        raise PlgsError("not-json", "this is not a JSON text", path, fix) from error
    if not text.strip():
        raise PlgsError("json-empty", "the JSON file is empty", path, fix)
    try:
        parse_int = _bounded if _LONG.search(data) else None  # the default is much faster
        return json.loads(text, parse_constant=_refuse_constant, parse_int=parse_int)
    except json.JSONDecodeError as error:
        what = f"the JSON is cut off or broken (line {error.lineno}: {error.msg})"
        raise PlgsError("json-broken", what, path, fix) from error
    except RecursionError as error:
        raise PlgsError("json-deep", "the JSON is nested too deeply", path, fix) from error
    except (ValueError, MemoryError) as error:  # such as a number of thousands of digits
        reason = str(error) or "no memory is left for it"
        raise PlgsError("json-unusable", f"the JSON cannot be used ({reason})", path, fix) from error


def _object(value: Any, path: Path, fix: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise PlgsError("not-object", f"the file holds {_kind_of(value)}, not an object", path, fix)
    return value


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


def _bounded(digits: str) -> int:
    number = int(digits) if len(digits) <= len(str(-_LARGEST)) else _LARGEST + 1
    if abs(number) > _LARGEST:
        raise ValueError(f"the number {digits[:12]}… has {len(digits)} digits")
    return number


def whole_number(text: str) -> int | None:
    """Return the whole number in a text of at most 18 decimal digits, such as a JSON key; None for other texts."""
    return int(text) if text.isdecimal() and len(text) <= 18 else None


def _kind_of(value: object) -> str:
    """Return JSON's name for the type of a value, for messages."""
    if value is None:
        return "null"
    names = {bool: "true or false", int: "a number", float: "a number", str: "a text", list: "a list"}
    return names.get(type(value), "an object")


def take_list(entry: dict[str, Any], key: str, context: str, path: Path) -> list[Any]:
    """Return the list ``entry[key]``, else raise PlgsError. ``context`` says whose key it is ("annotation 3")."""
    value = _take(entry, key, context, path)
    if not isinstance(value, list):
        raise wrong_type(key, "a list", value, context, path)
    return value


def take_objects(entry: dict[str, Any], key: str, context: str, path: Path) -> list[dict[str, Any]]:
    """Return ``entry[key]`` as a list of objects, else raise PlgsError. ``context`` says whose key it is."""
    value = take_list(entry, key, context, path)
    for item in value:
        if not isinstance(item, dict):
            raise wrong_type(key, "a list of objects", item, context, path)
    return value


def take_whole_number(
    entry: dict[str, Any], key: str, context: str, path: Path, *, least: int = -_LARGEST, most: int = _LARGEST
) -> int:
    """Return ``entry[key]`` as a whole number (2 or 2.0, not true, not "2") in ``least``..``most``, else raise
    PlgsError. ``context`` says whose key it is."""
    value = _take(entry, key, context, path)
    whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if isinstance(value, bool) or not whole:
        raise wrong_type(key, "a whole number", value, context, path)
    if not least <= value <= most:
        raise wrong_type(key, f"between {least} and {most}", value, context, path)
    return int(value)


def take_number(
    entry: dict[str, Any], key: str, context: str, path: Path, *, least: float = -1e300, most: float = 1e300
) -> float:
    """Return the finite number ``entry[key]`` in ``least``..``most``, else raise PlgsError; see `take_list`."""
    value = _take(entry, key, context, path)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        raise wrong_type(key, "a number", value, context, path)
    if not least <= value <= most:
        raise wrong_type(key, f"between {least:g} and {most:g}", value, context, path)
    return float(value)


def take_text(entry: dict[str, Any], key: str, context: str, path: Path) -> str:
    """Return ``entry[key]`` as a text that is not empty, else raise PlgsError. ``context`` says whose key it is."""
    value = _take(entry, key, context, path)
    if not isinstance(value, str) or not value:
        raise wrong_type(key, "a text", value, context, path)
    if any(unicodedata.category(character) in ("Cc", "Cs") for character in value):  # nothing could show or store it
        what = f'"{key}" of {context} has characters that names cannot have'
        raise PlgsError("bad-characters", what, path, "Correct the file.")
    return value


def take_flag(entry: dict[str, Any], key: str, context: str, path: Path) -> bool:
    """Return ``entry[key]`` as true or false, or written 1 or 0, else raise PlgsError. ``context`` says whose it is."""
    value = _take(entry, key, context, path)
    if value not in (0, 1) or isinstance(value, float):  # True and 1.0 equal 1
        raise wrong_type(key, "0 or 1", value, context, path)
    return bool(value)


def _take(entry: dict[str, Any], key: str, context: str, path: Path) -> Any:
    if key not in entry:
        raise PlgsError("lacks-field", f'{context} has no "{key}"', path, "Add it.")
    return entry[key]


def wrong_type(key: str, wanted: str, value: object, context: str, path: Path) -> PlgsError:
    """Return the error for a ``value`` that is not ``wanted`` ("a list"). ``context`` says whose ``key`` it is."""
    what = f'"{key}" of {context} must be {wanted}, not {shown_json(value)}'
    return PlgsError("wrong-type", what, path, "Correct the file.")


def shown_json(value: object) -> str:
    """Return a value as messages show it, shortened."""
    shown = repr(value) if isinstance(value, bool | int | float | str) else _kind_of(value)
    return shown[:60]
