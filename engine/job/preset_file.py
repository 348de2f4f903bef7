"""Presets as TOML: one that a user wrote, and those there are, in the same form."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..gates import read_plain
from .errors import JobError
from .json_file import Json
from .preset_options import PresetOption, checked_value, from_text, known_option, preset_options

BASE = "preset"
"""The key that names the preset which the file changes."""
MOST_BYTES = 1 << 20
"""Of a file; a whole preset is some thousands."""
_FIX = "'python -m engine presets preview' prints one that can be changed."


def read_preset_file(path: Path, known: tuple[str, ...]) -> tuple[str, dict[str, Json]]:
    """The preset that a file changes, and the options it gives. Raises JobError that names the file and the option."""
    try:
        content = tomllib.loads(read_plain(path, MOST_BYTES).decode("utf-8"))
    except OSError as error:
        raise JobError(f"cannot be read ({error.strerror})", path, _FIX) from error
    except (ValueError, RecursionError) as error:  # broken TOML, broken UTF-8, nested too deeply
        raise JobError(f"is not TOML ({error})", path, _FIX) from error
    base = content.pop(BASE, None)
    if base not in known:
        raise JobError(f"names no preset: {BASE} = {base!r}", path, f"Write {BASE} = one of {', '.join(known)}.")
    try:
        return base, dict(_options(content))
    except JobError as error:
        raise JobError(f"{error.what} ({error.where})", path, error.fix) from error


def _options(content: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Json]]:
    for key, value in content.items():
        name = f"{before}{key}"
        if isinstance(value, dict):
            yield from _options(value, f"{name}.")
            continue
        option = known_option(name)
        yield name, checked_value(option, from_text(option, value) if isinstance(value, str) else value)


def preset_values(base: str, options: Mapping[str, Json]) -> dict[str, Json]:
    """All options of a preset by name, with some changed."""
    return {name: options.get(name, option.values[base]) for name, option in preset_options().items()}


def preset_text(base: str, options: Mapping[str, Json]) -> str:
    """A preset with some options changed, as a file that ``read_preset_file`` reads."""
    every, values = preset_options(), preset_values(base, options)
    lines = [f'{BASE} = "{base}"']
    table = ""
    for option in sorted(every.values(), key=lambda one: _table_of(one.name) != ""):
        if not _is_written(option, values):
            continue
        if _table_of(option.name) != table:
            table = _table_of(option.name)
            lines += ["", f"[{table}]"]
        key = option.name.rpartition(".")[2]
        changed = "" if values[option.name] == option.values[base] else f", not {_toml(option.values[base])}"
        lines.append(f"{key} = {_toml(values[option.name])}  # {option.expected}{changed}")
    return "\n".join(lines) + "\n"


def _table_of(name: str) -> str:
    return name.rpartition(".")[0]


def _is_written(option: PresetOption, values: Mapping[str, Json]) -> bool:
    """A group stands as its table, or as "none"; what is within one that is left out has no value."""
    if option.kind == "part":
        return values[option.name] is None
    return values[option.name] is not None or values.get(_table_of(option.name), "default") is not None


def _toml(value: Json) -> str:
    if value is None:
        return '"none"'
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)
