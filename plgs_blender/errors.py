"""What users are told: errors, with the names of the panel's fields in place of a command's options, and counts."""

from __future__ import annotations

import re
from typing import Any

import bpy

from ..engine.errors import ErrorCode, PlgsError, one_line
from ..engine.posed.layout import plural

__all__ = ["EXPECTED", "ErrorCode", "PlgsError", "field_of_option", "one_line", "plural", "with_field_names"]

EXPECTED = (PlgsError, OSError)
"""The errors that an operator reports in one line. Anything else is a defect of ours and shows its traceback."""
_FIELD_OF_OPTION = {"classes": "classes_table", "set": "preset_options", "size": "width", "names-from": "keep_names"}
"""The fields whose names differ from the engine's option."""
_OTHER_NAMES = {
    "size": "Width and Height",
    "fix": "Fix",
    "resume": "Resume",
    "poses": "Find Poses",
    "download": "online access in Preferences > System",
}
"""The names in Blender of options that no field, or more than one, stands for."""
_OPTION = re.compile(r"(?<![\w-])--([a-z-]+)(?: [A-Z]+\b| colmap\b)?")


def with_field_names(said: PlgsError | OSError | str) -> str:
    """What the engine said, with the names of the panel's fields in place of the options of a command line, in one
    printable line.

    Paths stay as they are. The placeholder of an option, such as OUT, is removed with it.
    """
    where = said.where if isinstance(said, PlgsError) else ""
    before, where, after = str(said).partition(where) if where else ("", "", str(said))
    return one_line(_OPTION.sub(_name_in_panel, before) + where + _OPTION.sub(_name_in_panel, after))


def field_of_option(option: str) -> str | None:
    """The name of the settings' property that stands for an option of a command line, such as "--masks"."""
    name = option.removeprefix("--")
    field = _FIELD_OF_OPTION.get(name, name.replace("-", "_"))
    return field if field in _fields() else None


def _name_in_panel(option: re.Match[str]) -> str:
    field = field_of_option(option[1])
    if field is None or option[1] in _OTHER_NAMES:
        return _OTHER_NAMES.get(option[1], option[0])
    name: str = _fields()[field].name
    return name


def _fields() -> Any:
    """The properties of the panel's settings. Importing their module would make a cycle."""
    return bpy.types.Scene.bl_rna.properties["plgs"].fixed_type.properties
