"""Which numbering of a table masks have: told by what is in them, else the networks' own, and a warning says so.

ADE20K counts from 0 in networks and from 1 in its own files; COCO's 80 things are 0 to 79, or 1 to 90 with gaps;
detectron2 may number COCO's stuff apart from its things. ScanNet's files have its raw ids, NYU40's or NYU13's numbers:
masks that look like another of these than the named one are refused. The numbers of a ground truth are told likewise.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import PlgsError
from ..posed.layout import listed
from .class_choice import FILE_NAME, ClassChoice
from .class_tables import base_of, known_table, numberings_of
from .frame_choice import evenly_spread
from .mask_formats import MaskSource
from .noted import Inferred

_LOOKED_AT = 16
"""Frames whose masks are read."""
_ROOM = {"wall", "floor", "ceiling"}
_USUAL = {
    "ade20k": _ROOM,
    "nyu40": _ROOM,
    "nyu13": _ROOM,
    "scannet": _ROOM,
    "cityscapes": {"road", "sidewalk", "building", "vegetation", "sky", "car"},
    "coco": {
        "chair", "couch", "bed", "dining table", "toilet", "sink", "refrigerator",
        "wall-other-merged", "floor-other-merged", "floor-wood", "ceiling-merged",
    },
}  # fmt: skip
"""What frames of these tables show nearly always."""
_ALIKE = ("scannet", "nyu40", "nyu13")
"""Tables of the same scans: files of one are taken for those of another."""
_ENOUGH, _TIMES, _SEEN = 0.05, 2.0, 0.01
"""A numbering is told if this share of the pixels is usual in it, so many times as in any other. Each usual class that
has the third share counts once more: walls alone are less than walls and a floor."""
_SKY = 0.01
"""A share of sky with which a scene is no room, so it may lack wall and floor."""
_PANOPTIC = {"coco", "ade20k", "cityscapes"}
"""Tables whose data sets say which classes are things. In others this is a matter of taste."""
_KIND = {True: "a thing", False: "stuff"}
_UNNAMED = Inferred(
    "numbering", "classes are named by their numbers",
    "the masks do not say what their classes are called; name a table, such as --classes coco",
)  # fmt: skip
_OBJECTS = "the masks number objects and have no classes; {} beside them may give each number a name"
_CONTRADICTED = f"Name the network's table with --classes, or write {FILE_NAME} with each class's id, name and thing."


@dataclass(frozen=True)
class Asking:
    """Words for a message: ``whose`` numbers they are, and what a user does (``how``) to name a ``table``."""

    whose: str = "the masks'"
    table: str = "--classes {}"
    how: str = "name {}"
    option: str = "--classes"

    def advice(self, *tables: str) -> str:
        """What to do to name one of the tables."""
        return self.how.format(" or ".join(map(self.table.format, tables)))


@dataclass(frozen=True)
class _Reading:
    """One way to read the masks: their ``source`` and the name of a ``table``; ``what`` tells it in a message."""

    source: MaskSource
    table: str
    what: str


def numbered(
    source: MaskSource, choice: ClassChoice | None, where: Path, asking: Asking | None = None
) -> tuple[MaskSource, ClassChoice | None, tuple[Inferred, ...]]:
    """The masks and the choice of classes with the numbering of the choice's table, and what was inferred.

    Masks that number objects have no classes, so they take none from a table. Raises PlgsError where the files call
    things what the table calls stuff, in each numbering, and where the numbers are those of another table.
    """
    asking = asking or Asking()
    if choice is None:
        return source, None, () if source.kinds is None else (_UNNAMED,)
    if choice.table is None:
        return _as_rows_say(source, choice), choice, ()
    if source.tells_no_class:
        taken = f"the table {choice.table} is left out, and all are of the class object"
        return source, replace(choice, table=None), (Inferred("numbering", taken, _OBJECTS.format(FILE_NAME)),)
    readings = _readings(source, choice.table)
    agreeing = [each for each in readings if not _disagreements(each, choice)]
    usual = readings[0]
    wrong = [] if agreeing or source.kinds is None else _disagreements(usual, choice, is_known=True)
    if wrong:
        what = f"the files' isthing contradicts the table {choice.table}: {listed(wrong, 2)}"
        raise PlgsError(what, where, _CONTRADICTED, option="--classes")
    like = _tables_like(choice.table) if choice.table in _ALIKE else ()
    alike = [_Reading(source, each, each) for table in like for each in numberings_of(table)]
    chosen, reason, fitting = _told([*(agreeing or [usual]), *alike], choice)
    if chosen in alike:
        others = [each.table for each in fitting if each is not chosen]
        what = f"{asking.whose} numbers look like {chosen.table}, not {choice.table}: {reason or 'it has all of them'}"
        advice = asking.advice(chosen.table, *(others if reason is None or usual not in fitting else [usual.table]))
        raise PlgsError(what, where, f"{advice[0].upper()}{advice[1:]}.", option=asking.option)
    possible = (*agreeing, *(each for each in alike if each in fitting))
    others = [each.table for each in possible if each is not chosen]
    is_doubtful = chosen is not usual or reason is None
    is_told = is_doubtful or len(readings) > 1 or bool(alike)
    inferred = (_inferred(chosen, others, reason, is_doubtful, asking),) if is_told else ()
    return chosen.source, replace(choice, table=chosen.table), inferred


def other_numberings(choice: ClassChoice) -> str:
    """What else a message can advise to name: such as " or name --classes coco:90"."""
    table, base = choice.table or "", base_of(choice.table or "")
    others = [each for each in (*numberings_of(base), *_tables_like(base)) if each != table]
    return f", or name --classes {' or '.join(others)}" if others and table else ""


def _tables_like(table: str) -> tuple[str, ...]:
    """The tables whose files are taken for those of a table."""
    return tuple(each for each in _ALIKE if each != table) if table in (*_ALIKE, "scannet200") else ()


def _as_rows_say(source: MaskSource, choice: ClassChoice) -> MaskSource:
    """The masks whose things are nearest to those of rows with numbers, as an edited list of a table has them."""
    rows = {row.id: row.thing for row in choice.rows}
    ways = [source] if source.apart is None else [source, source.apart]
    return min(ways, key=lambda way: sum(rows.get(n) != is_thing for n, is_thing in (way.kinds or {}).items()))


def _readings(source: MaskSource, table: str) -> list[_Reading]:
    """All ways to read the masks with a table, the usual one first."""
    ways = [_Reading(source, each, each) for each in numberings_of(table)]
    has_stuff = source.kinds is not None and not all(source.kinds.values())
    if source.apart is not None and has_stuff and ways[0].table == numberings_of("coco")[0]:
        ways.append(_Reading(source.apart, ways[0].table, f"{ways[0].table} with stuff numbered apart from things"))
    return ways


def _disagreements(reading: _Reading, choice: ClassChoice, is_known: bool = False) -> list[str]:
    """How the files' things and stuff differ from the table's; with ``is_known``, only of numbers that it has. The
    user's own rows count for the files."""
    labels = {label.id: label for label in known_table(reading.table).labels}
    own = {row.name.casefold() if row.id is None and row.name else row.id for row in choice.rows}
    wrong, kinds = [], reading.source.kinds or {}
    for number, is_thing in kinds.items():
        label = labels.get(number)
        if number in own or number in choice.void or (label is not None and label.name in own):
            continue
        if label is None and not is_known:
            wrong.append(f"{number} is not in it")
        elif label is not None and label.is_thing != is_thing:
            wrong.append(f"{label.name} is {_KIND[label.is_thing]} there and {_KIND[is_thing]} in the files")
    is_strict = _base(reading) in _PANOPTIC
    return wrong if is_strict or len(wrong) > len(kinds) / 2 else []


def _told(readings: list[_Reading], choice: ClassChoice) -> tuple[_Reading, str | None, list[_Reading]]:
    """The reading that the masks tell, the reason, and all that fit; no reason if nothing tells it from the others."""
    if len(readings) == 1:
        return readings[0], "this alone fits what is a thing in the files", readings
    shares = _shares(readings[0].source, choice)
    fitting = [each for each in readings if not _unknown(each, shares, choice)]
    if not shares or not fitting:
        return readings[0], "no other fits", readings
    if len(fitting) == 1:
        numbers = sorted({number for each in readings for number in _unknown(each, shares, choice)})
        return fitting[0], f"this alone has the numbers {listed(numbers, 3)}", fitting
    is_indoors = _share(shares, fitting[0], {"sky"}) < _SKY
    for best in fitting if is_indoors else fitting[:1]:
        others = [each for each in fitting if each is not best]
        if all(_is_likelier(best, other, shares) for other in others):
            names, most = listed(sorted(_USUAL[_base(best)]), 3), max(_usual(each, shares) for each in others)
            told = f"{_usual(best, shares):.0%} of the pixels are then {names}, and {most:.0%} otherwise"
            return best, told, fitting
    return fitting[0], None, fitting


def _is_likelier(one: _Reading, other: _Reading, shares: Mapping[int, float]) -> bool:
    """Whether the numbers that mean different classes in the two readings speak for the first."""
    names, others = _names(one), _names(other)
    telling = {number: share for number, share in shares.items() if names.get(number) != others.get(number)}
    own = _usual(one, telling)
    return own >= _ENOUGH and own * _seen(one, telling) >= _TIMES * _usual(other, telling) * _seen(other, telling)


def _usual(reading: _Reading, shares: Mapping[int, float]) -> float:
    """The share of the pixels with a class that frames of this table show nearly always."""
    return _share(shares, reading, _USUAL[_base(reading)])


def _seen(reading: _Reading, shares: Mapping[int, float]) -> int:
    """How many of these classes are seen."""
    return sum(_share(shares, reading, {name}) >= _SEEN for name in _USUAL[_base(reading)])


def _names(reading: _Reading) -> dict[int, str]:
    return {label.id: label.name for label in known_table(reading.table).labels}


def _shares(source: MaskSource, choice: ClassChoice) -> dict[int, float]:
    """The share of each number in the pixels of some frames, without those that may mean nothing, as 0 often does
    where no other number does. Files that cannot be read are left out."""
    names, counts = list(source.masks), Counter[int]()
    for name in evenly_spread(names, _LOOKED_AT):
        try:
            found = source.masks[name].read()
        except PlgsError:  # whoever reads it later says so
            continue
        pixels = dict(enumerate(np.bincount(found.ids.ravel()).tolist()))
        for one in found.segments:
            counts[one.label] += pixels.get(one.id, 0)
    void = choice.void | source.void
    if any(counts[number] for number in void - {0}):
        void -= {0}
    kept = {number: count for number, count in counts.items() if count and number not in void}
    return {number: count / sum(kept.values()) for number, count in kept.items()}


def _unknown(reading: _Reading, numbers: Iterable[int], choice: ClassChoice) -> set[int]:
    """Those of the ``numbers`` that mean nothing in this reading."""
    table = known_table(reading.table)
    known = {label.id for label in table.labels} | table.void | reading.source.void
    return {*numbers} - known - {row.id for row in choice.rows if row.id is not None}


def _share(shares: Mapping[int, float], reading: _Reading, names: set[str]) -> float:
    """The share of the pixels with a class of these ``names``."""
    return sum(shares.get(label.id, 0.0) for label in known_table(reading.table).labels if label.name in names)


def _base(reading: _Reading) -> str:
    return base_of(reading.table)


def _inferred(chosen: _Reading, others: list[str], reason: str | None, is_doubtful: bool, asking: Asking) -> Inferred:
    """What the numbers are taken for, and what says otherwise."""
    why = "nothing in them tells" if reason is None else reason
    wrong = f"; if that is wrong, {asking.advice(*others)}" if others else ""
    return Inferred("numbering", f"{asking.whose} numbers are read as {chosen.what}", f"{why}{wrong}", is_doubtful)
