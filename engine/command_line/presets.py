"""``presets``: the presets and options to choose from."""

from __future__ import annotations

import json
import math
from dataclasses import asdict

from ..job import ExitCode
from ..job.options import chosen_options
from ..presets.options import option_value, parsed_options, preset_options, with_options
from ..presets.preset import PRESETS, Preset
from ..presets.toml_file import preset_text


def presets(name: str | None, sets: list[str] | None, *, as_json: bool) -> ExitCode:
    """Print the names of all presets or, as a file for --preset, one preset (a name or a file) with some options
    changed. ``as_json``: all options with their values in each preset, or the values of the one. Raises PlgsError."""
    if name is not None or sets:
        base, changed = chosen_options(name, parsed_options(sets or ()))
        chosen = with_options(PRESETS[base], changed)
        values = {option: option_value(chosen, option) for option in preset_options()}
        print(json.dumps(values) + "\n" if as_json else preset_text(base, changed), end="")
    elif as_json:
        print(json.dumps([_entry(option) for option in preset_options()], indent=1))
    else:
        print(*map(_line, PRESETS.values()), "", "'presets NAME' prints all options of one.", sep="\n")
    return ExitCode.FINISHED


def _entry(name: str) -> dict[str, object]:
    facts = {key: value for key, value in asdict(preset_options()[name]).items() if value and value != math.inf}
    return {**facts, "values": {base: option_value(preset, name) for base, preset in PRESETS.items()}}


def _line(preset: Preset) -> str:
    """A line such as "preview   500 steps, pictures within 200x200, objects by agreement, labels by votes"."""
    width, height = preset.size
    told = f"{preset.steps} steps, pictures within {width}x{height}, anchors every {preset.voxel_size} m"
    return f"{preset.name:<9} {told}, objects by {preset.objects}, labels by {preset.labels}"
