"""What the user says of the masks' classes: a small TOML file, ``classes.toml`` beside the masks or one that is named.

table = "coco"        # what the masks' numbers mean, where their files do not say: one of ``TABLES``
to = "reduced"        # turn the classes into the paper's 21
void = [255]          # numbers that mean nothing

[[class]]
id = 56               # the number in the masks, or a name that they have
name = "chair"
thing = true
into = "seat"         # counts as that class; "void": counts as nothing
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..gates import read_plain
from .class_tables import REDUCED, TABLES, known_table
from .classes import LARGEST_CLASS_ID, ClassLabel
from .frame import SceneError
from .layout import shown

FILE_NAME = "classes.toml"
_KEYS = {"table", "to", "void", "class"}
_ROW_KEYS = {"id", "name", "thing", "into"}
_LARGEST_FILE = 2**20


@dataclass(frozen=True)
class ClassRow:
    """What is said of one class; None where nothing is."""

    id: int | None = None
    name: str | None = None
    thing: bool | None = None
    into: str | None = None


@dataclass(frozen=True)
class ClassChoice:
    """The file's content; ``path`` is None for a table that was named without a file."""

    path: Path | None = None
    table: str | None = None
    to_reduced: bool = False
    void: frozenset[int] = frozenset()
    rows: tuple[ClassRow, ...] = ()

    @property
    def labels(self) -> tuple[ClassLabel, ...] | None:
        """The classes of the table, None where it names none."""
        return None if self.table is None else known_table(self.table).labels


def find_class_choice(named: str | None, beside: Path) -> ClassChoice | None:
    """The choice that ``named`` (a table's name, or a file) says, else that of ``classes.toml`` in the folder
    ``beside``; None where there is neither. Raises SceneError.
    """
    if named is None:
        path = beside / FILE_NAME
        return read_class_choice(path) if path.is_file() else None
    if named in TABLES:
        return ClassChoice(table=named)
    if not named.endswith(".toml"):
        fix = f"Name a .toml file, or one of {', '.join(TABLES)}."
        raise SceneError("there is no such table of classes", shown(named), fix)
    return read_class_choice(Path(named))


def read_class_choice(path: Path) -> ClassChoice:
    """The choice in a file. Raises SceneError that names the file and the key that is wrong."""
    try:
        content = tomllib.loads(read_plain(path, _LARGEST_FILE).decode("utf-8-sig"))
    except OSError as error:
        raise SceneError(f"the file cannot be read ({error.strerror})", path, "Check that it exists.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise SceneError(f"this is not a TOML text ({str(error).splitlines()[0]})", path, "Correct it.") from error
    _refuse_unknown(content, _KEYS, path)
    table, to, void = content.get("table"), content.get("to"), content.get("void", [])
    if table is not None and table not in TABLES:
        raise SceneError(f"the table {table!r} is not known"[:90], path, f"Choose one of {', '.join(TABLES)}.")
    if to not in (None, REDUCED):
        raise SceneError('"to" is not "reduced"', path, 'Write to = "reduced", or leave it out.')
    if not isinstance(void, list) or not all(type(each) is int for each in void):
        raise SceneError('"void" is no list of whole numbers', path, "Write it as void = [255].")
    rows = content.get("class", [])
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise SceneError('"class" is no list of tables', path, "Begin each with [[class]].")
    return ClassChoice(path, table, to is not None, frozenset(void), tuple(_row(row, path) for row in rows))


def _row(row: dict[str, Any], path: Path) -> ClassRow:
    _refuse_unknown(row, _ROW_KEYS, path)
    number, thing = row.get("id"), row.get("thing")
    if number is not None and (type(number) is not int or not 0 <= number <= LARGEST_CLASS_ID):
        raise SceneError('"id" of a class is no whole number from 0', path, "Write the number that the masks have.")
    if thing is not None and type(thing) is not bool:
        raise SceneError('"thing" of a class is neither true nor false', path, "Correct it.")
    for key in ("name", "into"):
        text = row.get(key)
        if text is not None and (not isinstance(text, str) or not text or not text.isprintable()):
            raise SceneError(f'"{key}" of a class is no name', path, "Write a text of one line.")
    if number is None and row.get("name") is None:
        raise SceneError("a class has neither id nor name", path, "Say which class is meant.")
    return ClassRow(number, row.get("name"), thing, row.get("into"))


def _refuse_unknown(content: dict[str, Any], known: set[str], path: Path) -> None:
    unknown = sorted(set(content) - known)
    if unknown:
        raise SceneError(f'the key "{unknown[0]}" is not known'[:90], path, f"Known are {', '.join(sorted(known))}.")


def class_choice_text(choice: ClassChoice) -> str:
    """The text of a file that says this."""
    lines = []
    if choice.table is not None:
        lines.append(f"table = {_quoted(choice.table)}")
    if choice.to_reduced:
        lines.append(f"to = {_quoted(REDUCED)}")
    if choice.void:
        lines.append(f"void = {sorted(choice.void)}")
    for row in choice.rows:
        lines += ["", "[[class]]", *_row_lines(row)]
    return "\n".join(lines) + "\n"


def _row_lines(row: ClassRow) -> Iterable[str]:
    if row.id is not None:
        yield f"id = {row.id}"
    if row.name is not None:
        yield f"name = {_quoted(row.name)}"
    if row.thing is not None:
        yield f"thing = {str(row.thing).lower()}"
    if row.into is not None:
        yield f"into = {_quoted(row.into)}"


def _quoted(text: str) -> str:
    """TOML's basic strings take JSON's escapes."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
