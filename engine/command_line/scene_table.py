"""A table of scenes, each with its own options: a CSV with a line, or a TOML file with a [[scene]], for each."""

from __future__ import annotations

import argparse
import csv
import io
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NoReturn

from ..errors import PlgsError
from ..gates import read_plain
from ..job.options import add_lift_options, readable

_MOST_BYTES = 1 << 26
_PATHS = ("scene", "masks", "depth", "names-from")
_OF_ALL = ("bake", "poses")
_FIX = "Write a column (CSV) or a key of a [[scene]] (TOML) 'scene', and others named as options of lift."


def read_scene_table(path: Path, options: argparse.Namespace) -> list[argparse.Namespace]:
    """The ``options`` of a command line for each scene of the table, changed as it says, with ``scene`` and
    ``scene_name`` (empty if it is not given). Paths in it are relative to its folder. Raises PlgsError, with the number
    of the scene."""
    found = []
    for number, row in enumerate(_rows(path), start=1):
        where = f"{path}, scene {number}"
        if not row.get("scene"):
            raise PlgsError("a scene has no 'scene'", where, _FIX)
        if of_all := [name for name in _OF_ALL if row.get(name)]:
            raise PlgsError(f"{of_all[0]} cannot differ between scenes", where, "Give it on the command line.")
        parser = _RowParser(where)
        parser.add_argument("--scene", type=Path)
        parser.add_argument("--name", dest="scene_name")
        add_lift_options(parser)
        arguments = [each for name, value in row.items() for each in _arguments(name, value, path.parent, where)]
        given = argparse.Namespace(**{**vars(options), "scene": None, "scene_name": ""})
        found.append(parser.parse_args(readable(arguments), given))
    return found


class _RowParser(argparse.ArgumentParser):
    """The options of a row, whose errors are a PlgsError."""

    def __init__(self, where: str) -> None:
        super().__init__(add_help=False, allow_abbrev=False)
        self._where = where

    def error(self, message: str) -> NoReturn:
        raise PlgsError(message, self._where, _FIX)


def _arguments(name: str, value: Any, folder: Path, where: str) -> Iterator[str]:
    """A cell as on a command line. Raises PlgsError for a value that is not a text, a number, true, or a list."""
    if isinstance(value, list):
        for each in value:
            yield from _arguments(name, each, folder, where)
    elif value is True or (name == "fit" and str(value).lower() in ("true", "yes", "1")):
        yield f"--{name}"
    elif name == "fit" and str(value).lower() in ("false", "no", "0"):
        return
    elif isinstance(value, str | int | float) and value is not False:
        is_path = name in _PATHS or str(value).endswith(".toml")
        yield f"--{name}={folder / str(value) if is_path else value}"
    elif value is not False:
        raise PlgsError(f"{name} is {value!r}", where, _FIX)


def _rows(path: Path) -> list[Mapping[str, Any]]:
    """The scenes with the names of their options, without empty cells. Raises PlgsError."""
    try:
        text = read_plain(path, _MOST_BYTES).decode("utf-8-sig")
        if path.suffix.lower() == ".toml":
            rows: Any = tomllib.loads(text).get("scene")
        else:
            rows = [*csv.DictReader(io.StringIO(text), restkey="", strict=True)]
        found: list[Mapping[str, Any]] = [
            {str(name).strip().replace("_", "-"): value for name, value in row.items() if value not in (None, "")}
            for row in rows
        ]
    except OSError as error:
        raise PlgsError(f"cannot be read ({error.strerror})", path, "Name a CSV or TOML file of scenes.") from error
    except (ValueError, TypeError, AttributeError, csv.Error) as error:
        raise PlgsError(f"is not a table of scenes ({error})", path, _FIX) from error
    if not found:
        raise PlgsError("names no scene", path, _FIX)
    return found
