"""Presets as TOML: those that a user wrote and the existing ones, in the same form."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..errors import PlgsError
from ..gates import read_plain
from ..json_file import Json
from .options import checked_value, known_option, option_value, preset_options, with_options
from .preset import PRESETS

BASE = "preset"
"""The key that names the preset which the file changes."""
MOST_BYTES = 1 << 20
"""The most bytes of such a file; a whole preset has a few thousand."""
_FIX = "'python -m engine presets preview' prints one that can be changed."


def read_preset_file(path: Path) -> tuple[str, dict[str, Json]]:
    """The preset that a file changes, and its options. Raises PlgsError, which names the file and the option."""
    try:
        content = tomllib.loads(read_plain(path, MOST_BYTES).decode("utf-8"))
    except OSError as error:
        raise PlgsError(f"cannot be read ({error.strerror})", path, _FIX) from error
    except (ValueError, RecursionError) as error:  # broken TOML, broken UTF-8, nested too deeply
        raise PlgsError(f"is not TOML ({error})", path, _FIX) from error
    base = content.pop(BASE, None)
    if base not in PRESETS:
        raise PlgsError(f"names no preset: {BASE} = {base!r}", path, f"Set {BASE} to one of {', '.join(PRESETS)}.")
    try:
        return base, dict(_options(content))
    except PlgsError as error:
        raise PlgsError(f"{error.what} ({error.where})", path, error.fix) from error


def _options(content: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Json]]:
    for key, value in content.items():
        name = f"{before}{key}"
        if isinstance(value, dict):
            yield from _options(value, f"{name}.")
        else:
            yield name, checked_value(known_option(name), value)


def preset_text(base: str, options: Mapping[str, Json]) -> str:
    """The text of a preset with some options changed, which ``read_preset_file`` reads."""
    preset, chosen = PRESETS[base], with_options(PRESETS[base], options)
    lines = [f'{BASE} = "{base}"']
    table = ""
    for option in sorted(preset_options().values(), key=lambda one: "." in one.name):
        group, _, key = option.name.rpartition(".")
        if group != table:
            table = group
            lines += ["", f"[{table}]"]
        own, value = option_value(preset, option.name), option_value(chosen, option.name)
        changed = "" if value == own else f", not {_toml(own)}"
        lines.append(f"{key} = {_toml(value)}  # {option.expected}{changed}")
    return "\n".join(lines) + "\n"


def _toml(value: Json) -> str:
    if value is None:
        return '"none"'
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)
