"""Parse, check, set and print the options of a preset by name, such as ``weights.depth``; and read presets in TOML."""

from __future__ import annotations

import math
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import Field, dataclass, fields, is_dataclass, replace
from functools import cache, reduce
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from ..errors import PlgsError, did_you_mean, reading
from ..gates import read_plain
from ..json_file import Json
from .parts import added_names, is_name
from .preset import PRESETS, Preset

LISTING = "python -m engine presets"
_KINDS = {"int": "a whole number", "float": "a number", "ints": "whole numbers", "bool": "true or false"}
_BOOLEANS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


@dataclass(frozen=True)
class PresetOption:
    """One option of a preset. ``length``: the number of values in a list; ``least`` and ``most`` bound a number, or
    each one in a list; ``choices``: the allowed texts; ``part``: a kind of `Parts` whose names are allowed, too."""

    name: str
    kind: Literal["bool", "int", "float", "choice", "ints", "names"]
    choices: tuple[str, ...] = ()
    part: str = ""
    length: int = 0
    least: float = 0
    most: float = math.inf
    can_be_none: bool = False

    @property
    def expected(self) -> str:
        """The valid values, described for a message."""
        text = _KINDS.get(self.kind, ", ".join(self.allowed))
        text = f"names of {text}" if self.kind == "names" else text
        if self.kind in ("int", "float", "ints"):
            text = f"{text} from {self.least:g}" + ("" if math.isinf(self.most) else f" to {self.most:g}")
        text = f"{self.length} {text}" if self.length else text
        return f"{text}, or none" if self.can_be_none else text

    @property
    def allowed(self) -> list[str]:
        """The texts that are valid now, with the names of parts that scripts have added."""
        return [*self.choices, *added_names(self.part)]


def preset_options() -> Mapping[str, PresetOption]:
    """Return all options by name, in the order of the presets' fields."""
    kind: Any = type(PRESETS["preview"])  # or a subclass with more options
    return _options_of(kind)


@cache
def _options_of(kind: Any) -> Mapping[str, PresetOption]:
    return {option.name: option for option in _options(kind)}


def _options(kind: Any, group: str = "") -> Iterator[PresetOption]:
    hints = get_type_hints(kind)
    for each in fields(kind):
        if is_dataclass(hints[each.name]):
            yield from _options(hints[each.name], f"{group}{each.name}.")
        elif each.name != "name":
            yield _option(f"{group}{each.name}", hints[each.name], each)


def _option(name: str, kind: Any, declared: Field) -> PresetOption:
    if "part" in declared.metadata:
        return PresetOption(name, "choice" if kind is str else "names", **declared.metadata)
    if get_origin(kind) is Literal:
        return PresetOption(name, "choice", get_args(kind))
    if get_origin(kind) is tuple:
        return PresetOption(name, "ints", length=len(get_args(kind)), **declared.metadata)
    can_be_none = NoneType in get_args(kind)
    found: Any = {bool: "bool", int: "int", float: "float"}[get_args(kind)[0] if can_be_none else kind]
    return PresetOption(name, found, can_be_none=can_be_none, **declared.metadata)


def option_value(preset: Preset, name: str) -> Json:
    """Return the value of an option in a preset, as a JSON value."""
    value: Any = reduce(getattr, name.split("."), preset)
    return list(value) if isinstance(value, tuple) else value


def with_options(preset: Preset, options: Mapping[str, Json]) -> Preset:
    """Return the preset with options changed, in the form that ``checked_options`` returns. If steps are given without
    ``steps_a_view``, exactly that many are done, however many views there are."""
    if "steps" in options:
        options = {"steps_a_view": 0.0, **options}
    for name, value in options.items():
        *groups, last = name.split(".")
        part: Any = reduce(getattr, groups, preset)
        part = replace(part, **{last: tuple(value) if isinstance(value, list) else value})
        preset = replace(preset, **{groups[0]: part}) if groups else part
    return preset


def changed_options(preset: Preset, options: Mapping[str, Json]) -> dict[str, Json]:
    """Return the options whose values differ from the preset's, by name."""
    chosen = with_options(preset, options)
    same_steps = (chosen.steps, chosen.steps_a_view) == (preset.steps, preset.steps_a_view)

    def changes(name: str) -> bool:
        if "steps" in options and name in ("steps", "steps_a_view"):  # steps alone mean exactly that many
            return not same_steps and (name == "steps" or chosen.steps_a_view > 0)
        return options[name] != option_value(preset, name)

    return {name: value for name, value in options.items() if changes(name)}


def parsed_options(texts: Iterable[str]) -> dict[str, Json]:
    """Parse options from ``name=value`` texts; later ones win. Raises PlgsError for an unknown name or a bad value."""
    found: dict[str, Json] = {}
    for text in texts:
        name, separator, value = text.partition("=")
        if not separator:
            what = "has no value"
            raise PlgsError("no-option", what, f"--set {text}", "Write name=value, such as weights.depth=0.")
        option = known_option(name.strip())
        found[option.name] = checked_value(option, value.strip())
    return found


def checked_options(options: Mapping[str, Json]) -> dict[str, Json]:
    """Return the options as checked JSON values, in the order of the presets' fields. Raises PlgsError for an unknown
    name or a bad value. Unknown names of parts are accepted: a lift can be read without the script that made them."""
    checked = {name: checked_value(known_option(name), value, any_part=True) for name, value in options.items()}
    return {name: checked[name] for name in preset_options() if name in checked}


def known_option(name: str) -> PresetOption:
    """Return the option with this name. Raises PlgsError, which suggests the closest name, if there is none."""
    options = preset_options()
    if name in options:
        return options[name]
    last = [known for known in options if known.rpartition(".")[2] == name]
    hint = did_you_mean(last[0] if last else name, options, 0.5)
    what = f"{name!r} is not an option of this version"
    raise PlgsError("no-option", what, "--set", f"{hint}'{LISTING} preview' lists them all.")


def checked_value(option: PresetOption, value: Json, *, any_part: bool = False) -> Json:
    """Return the checked value of a JSON value or a text, with whole numbers made floats where the option is one.
    Raises PlgsError for an invalid value. ``any_part``: unknown names of parts are valid."""
    found = _from_text(option, value) if isinstance(value, str) else value
    if found is None and option.can_be_none:
        return None
    checked: Json = None
    if option.kind == "bool" and isinstance(found, bool):
        checked = found
    elif option.kind == "choice" and _is_name(option, found, any_part):
        checked = found
    elif option.kind == "names" and isinstance(found, list | tuple):
        checked = list(found) if all(_is_name(option, each, any_part) for each in found) else None
    elif option.kind in ("int", "float"):
        checked = _number(option, found)
    elif isinstance(found, list | tuple) and len(found) == option.length:
        numbers: list[Json] = [_number(option, each) for each in found]
        checked = None if None in numbers else numbers
    if checked is None:
        fix = did_you_mean(str(value), option.allowed, 0.4)
        what = "is not a valid value"
        raise PlgsError("bad-value", what, f"{option.name} = {value!r}", f"{fix}Give {option.expected}.")
    return checked


def _is_name(option: PresetOption, value: Json, any_part: bool) -> bool:
    return value in option.allowed or bool(option.part and any_part and is_name(value))


def _number(option: PresetOption, value: Json) -> float | int | None:
    """Return the number, or None for a value that is not a number or out of the option's range."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not option.least <= value <= option.most:
        return None
    if option.kind == "float":
        return float(value) if value <= sys.float_info.max else None  # a larger int would raise OverflowError
    return int(value) if value == value // 1 else None  # 2.0 is whole, too


def _from_text(option: PresetOption, text: str) -> Json:
    """The JSON value that a text stands for. A text without such a meaning stays a text, which is refused later."""
    if option.kind == "choice":
        return text
    if option.kind == "names":
        return [part.strip() for part in text.split(",") if part.strip()] if text != "none" else []
    if text.lower() == "none":
        return None
    if option.kind == "bool":
        return _BOOLEANS.get(text.lower(), text)
    if option.kind == "ints":
        return [_as_number(part) for part in text.strip("[]()").replace("x", ",").split(",")]  # sizes may be 640x480
    return _as_number(text)


def _as_number(text: str) -> Json:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def shown_value(value: Json) -> str:
    """Return a value as a text that ``parsed_options`` reads."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "true" if value else "false"
    return ",".join(map(shown_value, value)) if isinstance(value, list) else str(value)


def shown_options(options: Mapping[str, Json]) -> list[str]:
    """Return the options as ``name=value`` texts, which ``parsed_options`` reads."""
    return [f"{name}={shown_value(value)}" for name, value in options.items()]


BASE = "preset"
"""Key of the preset that the file changes."""
MOST_BYTES = 1 << 20
"""The most bytes of a preset file; a whole preset has a few thousand."""
_FIX = "'python -m engine presets preview' prints one that can be changed."


def read_toml(path: Path, fix: str) -> dict[str, Any]:
    """Read a small TOML file. Raises PlgsError if it is unreadable and, with the advice ``fix``, if it is not TOML."""
    with reading(path, "Give a small TOML file that you have permission to read."):
        content = read_plain(path, MOST_BYTES)
    try:
        return tomllib.loads(content.decode("utf-8"))
    except (ValueError, RecursionError) as error:  # broken TOML, broken UTF-8, nested too deeply
        raise PlgsError("not-toml", f"is not TOML ({error})", path, fix) from error


def read_preset_file(path: Path) -> tuple[str, dict[str, Json]]:
    """The name of the preset that a file builds on, and the options it changes. Raises PlgsError for a wrong file."""
    content = read_toml(path, _FIX)
    base = content.pop(BASE, None)
    if base not in PRESETS:
        what = f"does not name a preset: {BASE} = {base!r}"
        raise PlgsError("preset-base", what, path, f"Set {BASE} to one of {', '.join(PRESETS)}.")
    try:
        return base, dict(_options_in(content))
    except PlgsError as error:
        raise PlgsError(error.key, error.problem, path, error.fix) from error


def _options_in(content: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Json]]:
    for key, value in content.items():
        name = f"{before}{key}"
        if isinstance(value, dict):
            yield from _options_in(value, f"{name}.")
        else:
            yield name, checked_value(known_option(name), value)


def preset_text(base: str, options: Mapping[str, Json]) -> str:
    """Return the text of a preset file that changes some options of ``base``; ``read_preset_file`` reads it."""
    preset, chosen = PRESETS[base], with_options(PRESETS[base], options)
    lines = [f'{BASE} = "{base}"']
    table = ""
    for option in sorted(preset_options().values(), key=lambda one: "." in one.name):  # TOML wants tables last
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
