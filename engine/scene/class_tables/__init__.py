"""Public class tables: the names of a data set's ids, which of them are things, and their class among the paper's 21.

One CSV per table: ``id`` in the results of networks trained on it, ``name``, ``thing`` (1 or 0), and in some tables
``reduced``, the class of ``reduced.csv`` (0 = void). ``coco.csv`` counts from 0 to 132; ``coco_id`` is the category id
in the data set's own files, 1 to 90 for things. ``cityscapes.csv`` has the 19 numbers that networks are trained on, and
the data set's own as ``label_id``; ``nyu40.csv`` has those of ScanNet's 20 classes too. ``scannet.csv`` has the ids of
ScanNet's raw labels, and ``scannet200.csv`` the commonest of them."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ...posed.classes import VOID, ClassLabel
from ...scene_source import NUMBERINGS as NUMBERINGS
from ...scene_source import TABLES as TABLES

REDUCED = "reduced"
_OF_NETWORKS = tuple(name for name in TABLES if name != "scannet")
"""Tables that tell things from stuff by name. ScanNet's raw labels have nearly every name; no network has them."""
_NUMBERS: Mapping[str, Callable[[Mapping[str, str]], int]] = {
    "ade20k:1-150": lambda row: int(row["id"]) + 1,
    "cityscapes:0-33": lambda row: int(row["label_id"]),
    "coco:90": lambda row: int(row["coco_id"]),
    "nyu13:0-12": lambda row: int(row["id"]) - 1,
    "nyu40:0-39": lambda row: int(row["id"]) - 1,
}
"""A row's number in each numbering other than ``id``."""
ANYTHING = 21  # the last of the paper's classes: all other things
_VOID_NAMES = ("void", "unlabeled", "unlabelled")
_VOID = {"cityscapes:0-33": frozenset({*range(7), 9, 10, 14, 15, 16, 18, 29, 30})}


@dataclass(frozen=True)
class KnownTable:
    """A public table: ``labels``, their class among the paper's 21 by id (``reduced``, maybe empty), ``void`` ids."""

    labels: tuple[ClassLabel, ...]
    reduced: dict[int, int]
    void: frozenset[int] = frozenset()


@cache
def known_table(name: str) -> KnownTable:
    """Return the table with a name in ``TABLES`` or ``NUMBERINGS``."""
    with (Path(__file__).parent / f"{base_of(name)}.csv").open(encoding="utf-8", newline="") as file:
        number = _NUMBERS.get(name, lambda row: int(row["id"]))
        rows = [(number(row), row) for row in csv.DictReader(file)]
    labels = tuple(ClassLabel(each, row["name"], row["thing"] == "1") for each, row in rows)
    reduced = {each: int(row["reduced"]) for each, row in rows if "reduced" in row}
    return KnownTable(labels, reduced, _VOID.get(name, frozenset()))


def numberings_of(table: str) -> tuple[str, ...]:
    """Return the ``NUMBERINGS`` of a table, the usual one first; if ``table`` names a numbering, only that."""
    return tuple(each for each in NUMBERINGS if base_of(each) == table) or (table,)


def base_of(table: str) -> str:
    """Return a table's name without its numbering, the part after ":"."""
    return table.partition(":")[0]


def nearest_tables(names: Iterable[str]) -> list[str]:
    """Return ``TABLES``, beginning with the one that has most of these names, as tables may disagree on a class: COCO
    counts traffic lights as things, Cityscapes does not."""
    words = {word for name in names for word in _words(name)}
    return sorted(_OF_NETWORKS, key=lambda table: -sum(label.name in words for label in known_table(table).labels))


def is_thing_by_name(name: str, tables: Sequence[str] = _OF_NETWORKS) -> bool | None:
    """Whether a class of this name is a thing in the first of the tables that has it; None if no table does. Of
    synonyms, as ADE20K's networks list them ("road, route"), the first known one counts."""
    for word in _words(name):
        for table in tables:
            for label in known_table(table).labels:
                if label.name == word:
                    return label.is_thing
    return None


def _words(name: str) -> tuple[str, ...]:
    return name.casefold(), *(part.strip() for part in name.casefold().split(","))


def reduced_by_name(name: str, with_raw: bool = False) -> int | None:
    """Return the class among the paper's 21 for a name, 0 = void; None if no table has the name. ``with_raw`` also
    accepts ScanNet's raw labels, unless they belong to the last class."""
    found = _reduced_names().get(name.casefold(), VOID if name.casefold() in _VOID_NAMES else None)
    if found is not None or not with_raw:
        return found
    raw = known_table("scannet")
    numbers = (raw.reduced[label.id] for label in raw.labels if label.name == name.casefold())
    return next((number for number in numbers if number != ANYTHING), None)


@cache
def _reduced_names() -> dict[str, int]:
    """Return the class among the paper's 21 for each name in a table; the first with the name counts."""
    found: dict[str, int] = {}
    for known in map(known_table, _OF_NETWORKS):
        for label in known.labels:
            if label.id in known.reduced:
                found.setdefault(label.name, known.reduced[label.id])
    return found
