"""The user's choice of the masks' classes: a small TOML file, ``classes.toml`` beside the masks or a named one.

table = "coco"        # the table of the masks' numbers, if their files have none: one of ``TABLES``
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

from ..errors import PlgsError
from ..posed.classes import LARGEST_CLASS_ID, ClassLabel
from ..posed.layout import read_file, shown
from .class_tables import REDUCED, TABLES, known_table

FILE_NAME = "classes.toml"
_KEYS = {"table", "to", "void", "class"}
_ROW_KEYS = {"id", "name", "thing", "into"}
_LARGEST_FILE = 2**20


@dataclass(frozen=True)
class ClassRow:
    """The choice for one class. Fields that it leaves alone are None."""

    id: int | None = None
    name: str | None = None
    thing: bool | None = None
    into: str | None = None


@dataclass(frozen=True)
class ClassChoice:
    """The file's content. ``path`` is None for a table that was named without a file."""

    path: Path | None = None
    table: str | None = None
    to_reduced: bool = False
    void: frozenset[int] = frozenset()
    rows: tuple[ClassRow, ...] = ()

    @property
    def labels(self) -> tuple[ClassLabel, ...] | None:
        """The classes of the named table, or None."""
        return None if self.table is None else known_table(self.table).labels


def find_class_choice(named: str | None, beside: Path) -> ClassChoice | None:
    """The choice in ``named`` (a table's name, or a file), else in ``classes.toml`` of the folder ``beside``, or None.

    Raises PlgsError.
    """
    if named is None:
        path = beside / FILE_NAME
        return read_class_choice(path) if path.is_file() else None
    if named in TABLES:
        return ClassChoice(table=named)
    if not named.endswith(".toml"):
        fix = f"Name a .toml file, or one of {', '.join(TABLES)}."
        raise PlgsError("there is no such table of classes", shown(named), fix)
    return read_class_choice(Path(named))


def read_class_choice(path: Path) -> ClassChoice:
    """The choice in a file. Raises PlgsError that names the file and the key that is wrong."""
    data = read_file(path, _LARGEST_FILE)
    try:
        content = tomllib.loads(data.decode("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PlgsError(f"this is not a TOML text ({str(error).splitlines()[0]})", path, "Correct it.") from error
    _refuse_unknown(content, _KEYS, path)
    table, to, void = content.get("table"), content.get("to"), content.get("void", [])
    if table is not None and table not in TABLES:
        raise PlgsError(f"the table {table!r} is not known"[:90], path, f"Choose one of {', '.join(TABLES)}.")
    if to not in (None, REDUCED):
        raise PlgsError('"to" is not "reduced"', path, 'Write to = "reduced", or leave it out.')
    if not isinstance(void, list) or not all(type(each) is int for each in void):
        raise PlgsError('"void" is no list of whole numbers', path, "Write it as void = [255].")
    rows = content.get("class", [])
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise PlgsError('"class" is no list of tables', path, "Begin each with [[class]].")
    return ClassChoice(path, table, to is not None, frozenset(void), tuple(_row(row, path) for row in rows))


def _row(row: dict[str, Any], path: Path) -> ClassRow:
    _refuse_unknown(row, _ROW_KEYS, path)
    number, thing = row.get("id"), row.get("thing")
    if number is not None and (type(number) is not int or not 0 <= number <= LARGEST_CLASS_ID):
        raise PlgsError('"id" of a class is no whole number from 0', path, "Write the number that the masks have.")
    if thing is not None and type(thing) is not bool:
        raise PlgsError('"thing" of a class is neither true nor false', path, "Correct it.")
    for key in ("name", "into"):
        text = row.get(key)
        if text is not None and (not isinstance(text, str) or not text or not text.isprintable()):
            raise PlgsError(f'"{key}" of a class is no name', path, "Write a text of one line.")
    if number is None and row.get("name") is None:
        raise PlgsError("a class has neither id nor name", path, "Say which class is meant.")
    return ClassRow(number, row.get("name"), thing, row.get("into"))


def _refuse_unknown(content: dict[str, Any], known: set[str], path: Path) -> None:
    unknown = sorted(set(content) - known)
    if unknown:
        raise PlgsError(f'the key "{unknown[0]}" is not known'[:90], path, f"Known are {', '.join(sorted(known))}.")


def class_choice_text(choice: ClassChoice) -> str:
    """The text of a file with this choice."""
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
