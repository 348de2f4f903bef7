"""``presets``: what there is to choose."""

from __future__ import annotations

import json

from ..job import PRESETS, ExitCode
from ..job.json_file import Json
from ..job.options import DEFAULTS, chosen_options
from ..job.preset_file import preset_text, preset_values
from ..job.preset_options import preset_options

OWN = (("steps", "steps"), ("size", "size_within"), ("frames", "most_frames"))
"""What a request has in a place of its own, and the option that it is."""


def presets(name: str | None, sets: list[str] | None, *, as_json: bool) -> ExitCode:
    """Print the names of all presets, or one (a name or a file), with some options changed, as a file that --preset
    takes. ``as_json``: the table that ``preset_options.json`` is, or the values of the one. Raises JobError."""
    if name is not None or sets:
        preset, changed = _changed(name, sets or [])
        print(json.dumps(preset_values(preset, changed)) + "\n" if as_json else preset_text(preset, changed), end="")
    elif as_json:
        from ..train.option_table import table_text

        print(table_text(), end="")
    else:
        print(*(_line(preset) for preset in PRESETS), "", "'presets NAME' prints all options of one.", sep="\n")
    return ExitCode.FINISHED


def _changed(name: str | None, sets: list[str]) -> tuple[str, dict[str, Json]]:
    """The preset's name, and the options that are other than its own."""
    chosen = chosen_options(name, sets, DEFAULTS)
    own = {option: chosen[key] for key, option in OWN if chosen.get(key) is not None}
    if "steps" in own:  # so many and no more, unless the options say otherwise
        own["steps_a_view"] = chosen["options"].get("steps_a_view", 0.0)
    return chosen["preset"], {**chosen["options"], **own}


def _line(preset: str) -> str:
    """Such as "preview   500 steps, pictures within 200x200, objects by agreement, labels by votes"."""
    values = {name: option.values[preset] for name, option in preset_options().items()}
    size = values["size_within"]
    assert isinstance(size, list)
    told = f"{values['steps']} steps, pictures within {size[0]}x{size[1]}, anchors every {values['voxel_size']} m"
    return f"{preset:<9} {told}, objects by {values['objects']}, labels by {values['labels']}"
