"""The colours of classes: by name, so that a class looks the same in every scene and in every lift."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from hashlib import sha256

from ..posed.classes import PALETTE, Category, ClassLabel, ClassTable
from .class_tables import known_table

_FIRST, _OTHERS = ("reduced", "nyu40"), ("nyu13", "scannet200", "replica", "coco", "ade20k", "cityscapes")
"""Public tables whose names take colours, the farthest first: those of rooms in their order, then what most tables
have. A table that is added here changes colours."""
_CALM = {"wall": 24, "floor": 21, "ceiling": 26}
"""Places of greyish colours for what fills most pictures. The names that were there take the bright ones."""
_FAR = 128
"""The first colours of the palette, among which no two are nearer than 9.5 by CIEDE2000. Others have 5.5."""


def coloured(labels: Iterable[ClassLabel]) -> ClassTable:
    """The table of ``labels`` in ascending order of id. A colour of their own stays.

    Else the palette has a place for each name of the public tables. Another name's place is drawn by a hash among the
    `_FAR`; if a class of this table has that, the next free one is taken. Raises ValueError as `ClassTable`.
    """
    labels = sorted(labels, key=lambda label: label.id)
    places = _places()
    chosen = {label.id: label.colour for label in labels if label.colour is not None}
    unknown = []
    for label in labels:
        place = next((places[word] for word in _words(label.name) if word in places), None)
        if place is None:
            unknown.append(label)
        else:
            chosen.setdefault(label.id, PALETTE[place])
    free = {*PALETTE}.difference(chosen.values())
    for label in sorted(unknown, key=lambda label: _words(label.name)):
        first = int.from_bytes(sha256(_words(label.name)[0].encode()).digest()[:4], "big") % _FAR
        in_turn = (*PALETTE[first:_FAR], *PALETTE[:first], *PALETTE[_FAR:]) if free else ()
        colour = chosen.setdefault(label.id, next((each for each in in_turn if each in free), PALETTE[first]))
        free.discard(colour)
    return ClassTable(tuple(Category(each.id, each.name, each.is_thing, chosen[each.id]) for each in labels))


@cache
def _places() -> dict[str, int]:
    """The place in the palette of every name in a public table."""
    first, others = ([_words(label.name)[0] for table in tables for label in known_table(table).labels]
                     for tables in (_FIRST, _OTHERS))  # fmt: skip
    by_tables = sorted(dict.fromkeys(others), key=lambda name: -others.count(name))
    names = list(dict.fromkeys([*first, *by_tables]))
    for name, place in _CALM.items():
        names[names.index(name)], names[place] = names[place], name
    return {name: place for place, name in enumerate(names)}


def _words(name: str) -> tuple[str, ...]:
    """A name as tables are searched for it, then each of its synonyms ("road, route")."""
    plain = " ".join(name.casefold().replace("-", " ").replace("_", " ").split())
    return plain, *(word.strip() for word in plain.split(","))
