"""Which numbering of a table masks have: told by what is in them, else the networks' own, and a warning says so.

ADE20K counts from 0 in networks and from 1 in its own files; COCO's 80 things are 0 to 79, or 1 to 90 with gaps;
detectron2 may number COCO's stuff apart from its things.
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
from .class_tables import known_table, numberings_of
from .mask_formats import MaskSource
from .noted import Inferred

_LOOKED_AT = 16
"""Frames whose masks are read."""
_USUAL = {
    "ade20k": {"wall", "floor", "ceiling"},
    "cityscapes": {"road", "sidewalk", "building", "vegetation", "sky", "car"},
    "coco": {
        "chair", "couch", "bed", "dining table", "toilet", "sink", "refrigerator",
        "wall-other-merged", "floor-other-merged", "floor-wood", "ceiling-merged",
    },
}  # fmt: skip
"""What frames of these tables show nearly always."""
_ENOUGH, _TIMES = 0.05, 2.0
"""A numbering is told if this share of the pixels is usual in it, so many times as in any other."""
_SKY = 0.01
"""A share of sky with which a scene is no room, so it may lack wall and floor."""
_PANOPTIC = {"coco", "ade20k", "cityscapes"}
"""Tables whose data sets say which classes are things. In others this is a matter of taste."""
_KIND = {True: "a thing", False: "stuff"}
_UNNAMED = Inferred(
    "numbering", "classes are named by their numbers",
    "the masks do not say what their classes are called; name a table, such as --classes coco",
)  # fmt: skip
_CONTRADICTED = f"Name the network's table with --classes, or write {FILE_NAME} with each class's id, name and thing."


@dataclass(frozen=True)
class _Reading:
    """One way to read the masks: their ``source`` and the name of a ``table``; ``what`` tells it in a message."""

    source: MaskSource
    table: str
    what: str


def numbered(
    source: MaskSource, choice: ClassChoice | None, where: Path
) -> tuple[MaskSource, ClassChoice | None, tuple[Inferred, ...]]:
    """The masks and the choice of classes with the numbering of the choice's table, and what was inferred.

    Raises PlgsError where the files call things what the table calls stuff, in each numbering.
    """
    if choice is None:
        return source, None, () if source.kinds is None else (_UNNAMED,)
    if choice.table is None or source.tells_no_class:
        return _as_rows_say(source, choice), choice, ()
    readings = _readings(source, choice.table)
    agreeing = [each for each in readings if not _disagreements(each, choice)]
    usual = readings[0]
    wrong = [] if agreeing or source.kinds is None else _disagreements(usual, choice, is_known=True)
    if wrong:
        what = f"the files' isthing contradicts the table {choice.table}: {listed(wrong, 2)}"
        raise PlgsError(what, where, _CONTRADICTED, option="--classes")
    chosen, reason = _told(agreeing or [usual], choice)
    others = [each.table for each in agreeing if each is not chosen]
    is_doubtful = chosen is not usual or reason is None
    inferred = (_inferred(chosen, others, reason, is_doubtful),) if is_doubtful or len(readings) > 1 else ()
    return chosen.source, replace(choice, table=chosen.table), inferred


def other_numberings(choice: ClassChoice) -> str:
    """What else a message can advise to name: such as " or name --classes coco:90"."""
    table = "" if choice.table is None else choice.table
    others = [each for each in numberings_of(table.partition(":")[0]) if each != table]
    return f", or name --classes {' or '.join(others)}" if others and table else ""


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
    is_strict = reading.table.partition(":")[0] in _PANOPTIC
    return wrong if is_strict or len(wrong) > len(kinds) / 2 else []


def _told(readings: list[_Reading], choice: ClassChoice) -> tuple[_Reading, str | None]:
    """The reading that the masks tell, and the reason; None if nothing tells it from the others."""
    if len(readings) == 1:
        return readings[0], "this alone fits what is a thing in the files"
    shares = _shares(readings[0].source, choice)
    fitting = [each for each in readings if not _unknown(each, shares, choice)]
    if not shares or not fitting:
        return readings[0], "no other fits"
    if len(fitting) == 1:
        numbers = sorted({number for each in readings for number in _unknown(each, shares, choice)})
        return fitting[0], f"this alone has the numbers {listed(numbers, 3)}"
    usual = [_share(shares, each, _USUAL[_base(each)]) for each in fitting]
    best = int(np.argmax(usual))
    others = max(share for place, share in enumerate(usual) if place != best)
    is_room = best == 0 or _share(shares, fitting[0], {"sky"}) < _SKY
    if usual[best] < _ENOUGH or usual[best] < _TIMES * others or not is_room:
        return fitting[0], None
    names = listed(sorted(_USUAL[_base(fitting[best])]), 3)
    return fitting[best], f"{usual[best]:.0%} of the pixels are then {names}, and {others:.0%} otherwise"


def _shares(source: MaskSource, choice: ClassChoice) -> dict[int, float]:
    """The share of each number in the pixels of some frames, without those that may mean nothing, as 0 often does.

    Files that cannot be read are left out.
    """
    names, counts = list(source.masks), Counter[int]()
    for place in sorted({*np.linspace(0, len(names) - 1, min(_LOOKED_AT, len(names))).round().astype(int).tolist()}):
        try:
            found = source.masks[names[place]].read()
        except PlgsError:  # whoever reads it later says so
            continue
        pixels = dict(enumerate(np.bincount(found.ids.ravel()).tolist()))
        for one in found.segments:
            counts[one.label] += pixels.get(one.id, 0)
    kept = {number: count for number, count in counts.items() if count and number not in choice.void | source.void}
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
    return reading.table.partition(":")[0]


def _inferred(chosen: _Reading, others: list[str], reason: str | None, is_doubtful: bool) -> Inferred:
    """What the numbers are taken for, and the option that says otherwise."""
    why = "nothing in the masks tells" if reason is None else reason
    wrong = f"; if that is wrong, name --classes {' or '.join(others)}" if others else ""
    return Inferred("numbering", f"the masks' numbers are read as {chosen.what}", f"{why}{wrong}", is_doubtful)
