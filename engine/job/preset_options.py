"""The choices of a preset by name, such as ``weights.depth``: what a user may set, checked where there is no torch.

``preset_options.json`` lists them, with their values in each preset. It is written by ``python -m engine presets
--json`` from the dataclasses of ``engine/train/presets.py``; a test holds both together.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from .errors import JobError
from .json_file import Json

TABLE = Path(__file__).with_suffix(".json")
LISTING = "python -m engine presets"
Kind = Literal["bool", "int", "float", "choice", "ints", "floats", "part"]
_WORDS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


@dataclass(frozen=True)
class PresetOption:
    """One choice. ``length``: of a list; ``least`` and ``most`` of a number, or of each in a list;
    ``choices``: of a text. A "part" is a group of options that can be left out as a whole: None, or "default".
    ``values``: in each preset, by its name.
    """

    name: str
    kind: Kind
    values: Mapping[str, Json]
    choices: tuple[str, ...] = ()
    length: int = 0
    least: float = 0.0
    most: float = math.inf
    can_be_none: bool = False

    @property
    def expected(self) -> str:
        """What a value has to be, in words."""
        many = f"{self.length} " if self.kind in ("ints", "floats") else ""
        kinds = {"int": "a whole number", "float": "a number", "ints": "whole numbers", "floats": "numbers"}
        if self.kind in kinds:
            most = "" if math.isinf(self.most) else f" to {self.most:g}"
            text = f"{many}{kinds[self.kind]} from {self.least:g}{most}"
        else:
            text = {"bool": "true or false", "part": "default", "choice": ", ".join(self.choices)}[self.kind]
        return f"{text}, or none" if self.can_be_none else text


@cache
def preset_options() -> Mapping[str, PresetOption]:
    """All options by name, in the order of the presets' fields."""
    entries = json.loads(TABLE.read_text(encoding="utf-8"))
    return {entry["name"]: _option(entry) for entry in entries}


def _option(entry: dict) -> PresetOption:
    most = entry.get("most", math.inf)
    return PresetOption(**{**entry, "choices": tuple(entry.get("choices", ())), "most": most})


def parsed_options(texts: Iterable[str]) -> dict[str, Json]:
    """The options of ``name=value`` texts; a later one wins. Raises JobError for a name or a value that is none."""
    found: dict[str, Json] = {}
    for text in texts:
        name, separator, value = text.partition("=")
        if not separator:
            raise JobError("is no option", f"--set {text}", "Write name=value, such as weights.depth=0.")
        option = known_option(name.strip())
        found[option.name] = checked_value(option, from_text(option, value.strip()))
    return found


def checked_options(options: Mapping[str, Json]) -> dict[str, Json]:
    """Options as JSON has them, in the order of the presets' fields. Raises JobError as ``parsed_options``."""
    checked = {name: checked_value(known_option(name), value) for name, value in options.items()}
    return {name: checked[name] for name in preset_options() if name in checked}


def known_option(name: str) -> PresetOption:
    """The option of that name. Raises JobError, which tells the nearest one, when there is none."""
    options = preset_options()
    if name in options:
        return options[name]
    last = [known for known in options if known.rpartition(".")[2] == name]
    near = last or difflib.get_close_matches(name, options, 1, 0.5)
    hint = f"Did you mean {near[0]}? " if near else ""
    raise JobError(f"there is no option {name!r}", "--set", f"{hint}'{LISTING} preview' lists them all.")


def checked_value(option: PresetOption, value: Json) -> Json:
    """The value as it is kept: floats where floats are wanted. Raises JobError for one that the option cannot have."""
    if value is None and option.can_be_none:
        return None
    checked: Json = None
    if option.kind == "bool" and isinstance(value, bool):
        checked = value
    elif option.kind in ("choice", "part"):
        checked = value if value in (option.choices or ("default",)) else None
    elif option.kind in ("int", "float"):
        checked = _number(option, value)
    elif isinstance(value, list) and len(value) == option.length:
        numbers: list[Json] = [_number(option, each) for each in value]
        checked = None if None in numbers else numbers
    if checked is None:
        near = difflib.get_close_matches(str(value), option.choices, 1, 0.4)
        fix = f"Did you mean {near[0]}? " if near else ""
        raise JobError("is no value of this option", f"{option.name} = {value!r}", f"{fix}Give {option.expected}.")
    return checked


def _number(option: PresetOption, value: Json) -> float | int | None:
    """None for what is no number, or out of range."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    if not option.least <= value <= option.most or (option.kind in ("int", "ints") and value != int(value)):
        return None
    return int(value) if option.kind in ("int", "ints") else float(value)


def from_text(option: PresetOption, text: str) -> Json:
    """A text as the JSON value that it means; texts that mean none stay texts, and are refused as values."""
    if text.lower() == "none" and "none" not in option.choices:
        return None
    if option.kind == "bool":
        return _WORDS.get(text.lower(), text)
    if option.kind in ("int", "float"):
        return _as_number(text)
    if option.kind in ("ints", "floats"):
        return [_as_number(part) for part in text.strip("[]()").replace("x", ",").split(",")]
    return text


def _as_number(text: str) -> Json:
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        return text


def shown_value(value: Json) -> str:
    """A value as ``parsed_options`` reads it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "true" if value else "false"
    return ",".join(map(shown_value, value)) if isinstance(value, list) else str(value)


def shown_options(options: Mapping[str, Json]) -> list[str]:
    """``name=value`` texts that ``parsed_options`` reads."""
    return [f"{name}={shown_value(value)}" for name, value in options.items()]
