"""Public tables of classes: names of a data set's ids, which of them are things, and their class of the paper's 21.

One CSV per table: ``id`` in the results of networks trained on it, ``name``, ``thing`` (1 or 0), and in some tables
``reduced``, the class of ``reduced.csv`` (0 = void). ``coco.csv`` counts from 0 to 132; ``coco_id`` is the category id
of the data set's own files, 1 to 90 for things. ``cityscapes.csv`` has the 19 numbers that networks are trained on, and
as ``label_id`` the data set's own; ``nyu40.csv`` has those of ScanNet's 20 classes too, and ``scannet200.csv`` the
numbers of ScanNet's labels.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ...posed.classes import VOID, ClassLabel
from ...posed.format_names import NUMBERINGS as NUMBERINGS
from ...posed.format_names import TABLES as TABLES

REDUCED = "reduced"
_NUMBERS: Mapping[str, Callable[[Mapping[str, str]], int]] = {
    "ade20k:1-150": lambda row: int(row["id"]) + 1,
    "cityscapes:0-33": lambda row: int(row["label_id"]),
    "coco:90": lambda row: int(row["coco_id"]),
}
"""The number of a row in the data set's own files; networks have its ``id``."""
_VOID = {"cityscapes:0-33": frozenset({*range(7), 9, 10, 14, 15, 16, 18, 29, 30})}


@dataclass(frozen=True)
class KnownTable:
    """``labels`` in order of id. ``reduced`` maps ids to the paper's 21 classes; it may be empty. ``void``: numbers
    that mean nothing."""

    labels: tuple[ClassLabel, ...]
    reduced: dict[int, int]
    void: frozenset[int] = frozenset()


@cache
def known_table(name: str) -> KnownTable:
    """The table of a name in ``TABLES`` or ``NUMBERINGS``."""
    with (Path(__file__).parent / f"{name.partition(':')[0]}.csv").open(encoding="utf-8", newline="") as file:
        number = _NUMBERS.get(name, lambda row: int(row["id"]))
        rows = [(number(row), row) for row in csv.DictReader(file)]
    labels = tuple(ClassLabel(each, row["name"], row["thing"] == "1") for each, row in rows)
    reduced = {each: int(row["reduced"]) for each, row in rows if "reduced" in row}
    return KnownTable(labels, reduced, _VOID.get(name, frozenset()))


def numberings_of(table: str) -> tuple[str, ...]:
    """The names in ``NUMBERINGS`` of a table that is named alone, the networks' first; else the name as it is."""
    return tuple(each for each in NUMBERINGS if each.partition(":")[0] == table) or (table,)


def nearest_tables(names: Iterable[str]) -> list[str]:
    """``TABLES``, the one with the most classes of these names first, as another table may mean something else by them:
    COCO counts traffic lights, Cityscapes does not."""
    words = {word for name in names for word in _words(name)}
    return sorted(TABLES, key=lambda table: -sum(label.name in words for label in known_table(table).labels))


def is_thing_by_name(name: str, tables: Sequence[str] = TABLES) -> bool | None:
    """Whether a class of this name is a thing in the first of the tables that has it; None if no table has it.

    Among synonyms, as ADE20K's networks list them ("road, route"), the first known one counts.
    """
    for word in _words(name):
        for table in tables:
            for label in known_table(table).labels:
                if label.name == word:
                    return label.is_thing
    return None


def _words(name: str) -> tuple[str, ...]:
    return name.casefold(), *(part.strip() for part in name.casefold().split(","))


def reduced_by_name(name: str) -> int | None:
    """The class among the paper's 21 that a class of this name is, 0 = void; None if no table has it."""
    for table in TABLES:
        known = known_table(table)
        for label in known.labels:
            if label.name == name.casefold() and label.id in known.reduced:
                return known.reduced[label.id]
    return VOID if name.casefold() in ("void", "unlabeled", "unlabelled") else None
