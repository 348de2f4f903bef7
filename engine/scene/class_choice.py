"""The user's choice of the masks' classes: a small TOML file, ``classes.toml`` beside the masks or one given by path.

* ``table = "coco"``: the table of the masks' numbers, if their files have none: one of ``TABLES`` or ``NUMBERINGS``.
* ``to = "reduced"``: maps the classes to the paper's 21. ``void = [255]``: numbers that mean nothing.
* ``[[class]]``, for each class: ``id = 56``, the number in the masks, or a ``name`` that they have; ``thing = true``;
  ``into = "seat"``, the class that it counts as ("void": nothing); ``colour = "#c8a064"``."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from ..errors import PlgsError
from ..posed.classes import LARGEST_CLASS_ID, ClassLabel
from ..posed.layout import read_file, shown
from ..records import record_of
from .class_tables import NUMBERINGS, REDUCED, TABLES, known_table

FILE_NAME = "classes.toml"
_LARGEST_FILE = 2**20
_NAMES = (*TABLES, *NUMBERINGS)


@dataclass(frozen=True)
class ClassRow:
    """The user's choice for one class, found by ``id`` or ``name``: whether it is a ``thing``, the class ``into`` which
    it is merged, its ``colour`` ("#rrggbb"). Fields that are not set are None."""

    id: int | None = field(default=None, metadata={"least": 0, "most": LARGEST_CLASS_ID})
    name: str | None = None
    thing: bool | None = None
    into: str | None = None
    colour: str | None = None

    def __post_init__(self) -> None:
        if self.id is None and self.name is None:
            raise ValueError("it has neither id nor name")
        if not all(text is None or (text and text.isprintable()) for text in (self.name, self.into)):
            raise ValueError("a name is not a text of one line")
        if self.colour is not None and not re.fullmatch("#[0-9a-fA-F]{6}", self.colour):
            raise ValueError('the text is not a colour such as "#c8a064"')

    @property
    def rgb(self) -> tuple[int, int, int] | None:
        return None if self.colour is None else (*bytes.fromhex(self.colour[1:]),)


@dataclass(frozen=True)
class _Content:
    """The top-level keys of a classes.toml, which `ClassChoice` explains."""

    table: str | None = None
    to: Literal["reduced"] | None = None
    void: tuple[int, ...] = ()


@dataclass(frozen=True)
class ClassChoice:
    """The content of a classes.toml: the ``table`` of the numbers, whether classes are mapped ``to_reduced``, the
    paper's 21, numbers that are ``void``, and the ``rows``. ``path`` is None for a named table."""

    path: Path | None = None
    table: str | None = None
    to_reduced: bool = False
    void: frozenset[int] = frozenset()
    rows: tuple[ClassRow, ...] = ()

    @property
    def labels(self) -> tuple[ClassLabel, ...] | None:
        """The classes of the named table, None if none is named."""
        return None if self.table is None else known_table(self.table).labels


def find_class_choice(named: str | None, beside: Path) -> ClassChoice | None:
    """Return the choice that ``named`` means (a table or a file), else that of a classes.toml in the folder ``beside``,
    else None: the user chose nothing. Raises PlgsError if ``named`` is no table and no valid file."""
    if named is None:
        path = beside / FILE_NAME
        return read_class_choice(path) if path.is_file() else None
    if named in _NAMES:
        return ClassChoice(table=named)
    if not named.endswith(".toml"):
        fix = f"Name a .toml file, or one of {', '.join(_NAMES)}."
        raise PlgsError("no-class-table", "the class table is unknown", shown(named), fix)
    return read_class_choice(Path(named))


def read_class_choice(path: Path) -> ClassChoice:
    """Read the choice from a file. Raises a PlgsError that names the file and the wrong key."""
    data = read_file(path, _LARGEST_FILE)
    try:
        content = tomllib.loads(data.decode("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        what = f"this is not a TOML text ({str(error).splitlines()[0]})"
        raise PlgsError("not-toml", what, path, "Correct it.") from error
    rows = content.pop("class", [])
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise PlgsError("classes-not-list", '"class" is not a list of tables', path, "Begin each with [[class]].")
    said = record_of(_Content, content, path, "Correct it.")
    if said.table is not None and said.table not in _NAMES:
        what = f"the table {said.table!r} is not known"[:90]
        raise PlgsError("unknown-table", what, path, f"Choose one of {', '.join(_NAMES)}.")
    chosen = (record_of(ClassRow, row, path, "Correct it.", f"class[{n}]") for n, row in enumerate(rows))
    return ClassChoice(path, said.table, said.to is not None, frozenset(said.void), tuple(chosen))


def class_choice_text(choice: ClassChoice) -> str:
    """Return the choice as the text of a classes.toml."""
    lines = []
    if choice.table is not None:
        lines.append(f"table = {_toml(choice.table)}")
    if choice.to_reduced:
        lines.append(f"to = {_toml(REDUCED)}")
    if choice.void:
        lines.append(f"void = {sorted(choice.void)}")
    for row in choice.rows:
        given = {key: value for key, value in asdict(row).items() if value is not None}
        lines += ["", "[[class]]", *(f"{key} = {_toml(value)}" for key, value in given.items())]
    return "\n".join(lines) + "\n"


def _toml(value: str | int) -> str:
    """Write a value as TOML, whose texts, numbers and true look as in JSON."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
