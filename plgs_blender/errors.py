"""Texts of errors and counts for users, with the panel's field names in place of command-line options."""

from __future__ import annotations

import re
from typing import Any

import bpy

from ..engine.errors import ErrorCode, PlgsError, ended, one_line, problem_of
from ..engine.posed.layout import plural

__all__ = [
    "EXPECTED", "ErrorCode", "PlgsError", "field_of_option", "one_line", "plural", "sentence", "with_field_names",
]  # fmt: skip

EXPECTED = (PlgsError, OSError)
"""Errors that an operator reports in one line. Any other is a bug of ours and shows its traceback."""
_FIELD_OF_OPTION = {"classes": "classes_table", "set": "preset_options", "size": "width"}
_FIELD_OF_OPTION |= {"names-from": "keep_names", "replace": "replace_shot"}
"""Fields whose names differ from the engine's option."""
_OTHER_NAMES = {
    "size": "Width and Height",
    "fix": "Fix",
    "resume": "Resume",
    "poses": "Find Poses",
    "download": "online access in Preferences > System",
}
"""Blender's names of options that match no field, or more than one."""
_OPTION = re.compile(r"(?:lift (?=--poses))?(?<![\w-])--([a-z-]+)(?: [A-Z]+\b| colmap\b)?")
_COMMAND = (
    r"'?(?:(?:'[^']*'|\S+) -m engine|the command) "
    r"(add|segment|poses|depth|lift(?= \S+ --resume)|inspect(?= \S+ --fix))\b"
    r"(?: [A-Z]+\b| --resume| --fix| \w+(?=\.))*'?"
)
"""A command of the engine, as messages name it for a terminal."""
_ADVISED = re.compile(rf"[A-Z][^.:]*: {_COMMAND}(?=\.|$)")
"""A sentence that ends in such a command."""
_BUTTONS = {"add": "Add to Engine", "segment": "Make Masks", "poses": "Find Poses", "depth": "Make Depth"}
_BUTTONS |= {"lift": "Resume", "inspect": "Fix"}
"""The button that does what a command does."""
_PLAIN_WORD = re.compile(r"[a-z]+(?=[ ,:;.]?( |$))")


def with_field_names(said: PlgsError | OSError | str) -> str:
    """Return the engine's message in one printable line, with the panel's field names in place of command-line options.
    Paths stay as they are. An option's placeholder, such as OUT, is removed with it."""
    if not isinstance(said, PlgsError):
        return one_line(_for_panel(str(said)))
    what, fix = _for_panel(said.what), _for_panel(said.fix)
    where = sentence(said.where) if said.where.startswith("the ") else said.where
    problem = problem_of(what, where)
    if not where or not problem.startswith(where):  # a name keeps its first letter
        problem = sentence(problem)
    return one_line(f"{ended(problem)} {fix}" if fix else problem)


def _for_panel(text: str) -> str:
    """Return the text with names of buttons in place of commands, and of fields in place of options."""
    text = _ADVISED.sub(lambda found: f"Press {_BUTTONS[found[1]]}", text)
    return _OPTION.sub(_name_in_panel, re.sub(_COMMAND, lambda found: _BUTTONS[found[1]], text))


def sentence(text: str) -> str:
    """Return the text with a capital first letter, unless it begins with a file name, a key or anything in quotes."""
    return f"{text[0].upper()}{text[1:]}" if _PLAIN_WORD.match(text) else text


def field_of_option(option: str) -> str | None:
    """Return the settings' property for a command-line option such as "--masks"; None if the option has none."""
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
    """Return the properties of the panel's settings. Importing their module above would make a cycle."""
    return bpy.types.Scene.bl_rna.properties["plgs"].fixed_type.properties
