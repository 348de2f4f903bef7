"""Find the numbering of classes that masks or ground truth use: by their content, otherwise that which networks use,
with a warning. Also warn if the numbers look far more like those of another table than of the named one.

ADE20K counts from 0 in networks and from 1 in its own files; COCO's 80 things are 0 to 79, or 1 to 90 with gaps;
detectron2 may number COCO's stuff apart from its things. ScanNet's files have its raw ids, NYU40's or NYU13's numbers:
masks that look like one of these other than the named one are refused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import PlgsError
from ..posed.layout import listed
from .class_choice import FILE_NAME, ClassChoice
from .class_tables import TABLES, base_of, known_table, numberings_of
from .frame import Inferred
from .frame_choice import evenly_spread
from .mask_formats import MaskSource

_LOOKED_AT = 16  # maximum number of frames whose masks are inspected
_ROOM = {"wall", "floor", "ceiling"}
_USUAL = {
    **dict.fromkeys(("ade20k", "nyu40", "nyu13", "scannet", "scannet200", "replica", "reduced"), _ROOM),
    "cityscapes": {"road", "sidewalk", "building", "vegetation", "sky", "car"},
    "coco": {
        "chair", "couch", "bed", "dining table", "toilet", "sink", "refrigerator",
        "wall-other-merged", "floor-other-merged", "floor-wood", "ceiling-merged",
    },
}  # fmt: skip
"""Classes that frames with these tables nearly always show."""
_ALIKE = ("scannet", "nyu40", "nyu13")  # tables of the same scans, whose files are easily confused
_ENOUGH, _TIMES, _SEEN = 0.05, 2.0, 0.01
"""A numbering is recognised if this fraction of pixels has usual classes in it, and this many times more than in any
other. The more usual classes with at least the third fraction, the better: walls alone are weaker evidence than walls
and a floor."""
_SKY = 0.01  # with more than this fraction of sky, a scene is not a room, so it may lack walls and floor
_SKIES = {"sky", "sky-other-merged"}
_HEIGHTS = {
    **dict.fromkeys(_SKIES, (2 / 3, 1.0)), **dict.fromkeys(("ceiling", "ceiling-merged"), (0.4, 1.0)),
    **dict.fromkeys(("floor", "floor-other-merged", "floor-wood", "road"), (0.0, 0.6)),
}  # fmt: skip
"""The fraction of each class that may lie in the upper halves of pictures: in the sample 13 % of the floor and all of
the ceiling. It rules out a floor that is read as sky, or a sofa as ceiling."""
_OTHER_TABLE = 0.2
"""Masks look like another table if this fraction of the pixels has usual classes there, and more than a third of these
classes occur, or more than two: two of wall, floor and ceiling."""
_PANOPTIC = {"coco", "ade20k", "cityscapes"}  # they define which classes are things; in others, it is a matter of taste
_KIND = {True: "a thing", False: "stuff"}
_UNNAMED = Inferred(
    "numbering", "classes are named by their numbers",
    "the masks do not say what their classes are called; name a table, such as --classes coco",
)  # fmt: skip
_OBJECTS = "the masks number objects and have no classes; {} beside them may give each number a name"
_CONTRADICTED = f"Name the network's table with --classes, or write {FILE_NAME} with each class's id, name and thing."


@dataclass(frozen=True)
class Asking:
    """Words of messages about a numbering: ``whose`` they are, and how users name a ``table`` with ``option``."""

    whose: str = "the masks'"
    table: str = "--classes {}"
    how: str = "name {}"
    option: str = "--classes"

    def advice(self, *tables: str) -> str:
        """Return the advice to name one of the tables, such as "name --classes coco"."""
        return self.how.format(" or ".join(map(self.table.format, tables)))


@dataclass(frozen=True)
class _Shown:
    """Statistics of some frames: the share of all pixels that each class number has, and which part of these pixels is
    in the upper half of its picture."""

    shares: Mapping[int, float]
    upper: Mapping[int, float]

    def share(self, reading: _Reading, names: set[str], *, anywhere: bool = False) -> float:
        """The fraction of pixels whose class is among ``names`` and, unless ``anywhere``, is at its usual height."""
        labels = (label for label in known_table(reading.table).labels if label.name in names)
        heights = ((label.id, *_HEIGHTS.get(label.name, (0.0, 1.0))) for label in labels if label.id in self.shares)
        seen = ((self.shares[n], anywhere or least <= self.upper[n] <= most) for n, least, most in heights)
        return sum(share for share, is_usual in seen if is_usual)


@dataclass(frozen=True)
class _Reading:
    """One way to read the masks: their ``source``, and a class ``table``; ``what`` describes it in messages."""

    source: MaskSource
    table: str
    what: str

    @property
    def usual(self) -> set[str]:
        """The classes that occur in nearly all frames whose masks use this table."""
        return _USUAL[base_of(self.table)]

    @property
    def names(self) -> dict[int, str]:
        return {label.id: label.name for label in known_table(self.table).labels}


Numbered = tuple[MaskSource, ClassChoice | None, tuple[Inferred, ...]]
"""The masks and the choice of classes, with the numbering that was found, and what was inferred."""


def numbered(source: MaskSource, choice: ClassChoice | None, where: Path, asking: Asking | None = None) -> Numbered:
    """Return the masks, the choice of classes with the numbering found for its table, and what was inferred. Masks that
    number objects get no table. ``where`` and ``asking`` are for messages. Raises PlgsError if every numbering would
    make things stuff, or if another table fits."""
    if choice is None and source.tells_no_class:
        return source, None, (Inferred("numbering", "all are of the class object", _OBJECTS.format(FILE_NAME)),)
    if choice is None:
        return source, None, () if source.kinds is None else (_UNNAMED,)
    if choice.table is None:
        return _as_listed(source, choice), choice, ()
    if source.tells_no_class:
        taken = f"the table {choice.table} is left out, and all are of the class object"
        return source, replace(choice, table=None), (Inferred("numbering", taken, _OBJECTS.format(FILE_NAME)),)
    found = _find(source, choice, _agreeing_readings(source, choice, where))
    asking = asking or Asking()
    _refuse_other_table(found, choice, asking, where)
    inferred = _doubts_of_table(found, choice, asking) or _doubts(found, asking)
    return found.chosen.source, replace(choice, table=found.chosen.table), inferred


def _as_listed(source: MaskSource, choice: ClassChoice) -> MaskSource:
    """Return the masks, read in the one of two ways in which kinds of classes agree best with an edited list."""
    rows = {row.id: row.thing for row in choice.rows}
    ways = [source] if source.apart is None else [source, source.apart]
    wrong_kinds = [sum(rows.get(n) != is_thing for n, is_thing in (way.kinds or {}).items()) for way in ways]
    return ways[int(np.argmin(wrong_kinds))]


def _agreeing_readings(source: MaskSource, choice: ClassChoice, where: Path) -> list[_Reading]:
    """Return the readings that agree with what the files call things, the usual one first; all of them if the files
    call nothing so. Raises PlgsError if none agrees."""
    readings = _readings(source, choice.table or "")
    agreeing = [each for each in readings if not _disagreements(each, choice)]
    wrong = [] if agreeing or source.kinds is None else _disagreements(readings[0], choice, is_known=True)
    if wrong:
        what = f"the files' isthing contradicts the table {choice.table}: {listed(wrong, 2)}"
        raise PlgsError("isthing-contradicts", what, where, _CONTRADICTED, option="--classes")
    return agreeing or readings[:1]


@dataclass(frozen=True)
class _Found:
    """The outcome of the search. ``chosen`` is one of the ``agreeing`` readings (those of the named table that agree
    with the files), or of ``alike`` (those of other tables). ``fitting`` are all that fit, ``every`` all of the named
    table, the usual one first. ``shown`` are the frames' statistics. ``reason`` is None if the masks are ambiguous."""

    chosen: _Reading
    reason: str | None
    fitting: list[_Reading]
    agreeing: list[_Reading]
    alike: list[_Reading]
    every: list[_Reading]
    shown: _Shown


def _find(source: MaskSource, choice: ClassChoice, agreeing: list[_Reading]) -> _Found:
    like = _tables_like(choice.table or "") if choice.table in _ALIKE else ()
    alike = [_Reading(source, each, each) for table in like for each in numberings_of(table)]
    shown = _shown(source, choice)
    every = _readings(source, choice.table or "")
    return _Found(*_told([*agreeing, *alike], choice, shown), agreeing, alike, every, shown)


def _refuse_other_table(found: _Found, choice: ClassChoice, asking: Asking, where: Path) -> None:
    if found.chosen not in found.alike:
        return
    chosen, reason = found.chosen.table, found.reason
    others = [each.table for each in found.fitting if each is not found.chosen]
    is_usual = reason is not None and found.every[0] in found.fitting
    advice = asking.advice(chosen, *([found.every[0].table] if is_usual else others))
    what = f"{asking.whose} numbers look like {chosen}, not {choice.table}: {reason or 'it has all of them'}"
    raise PlgsError("other-numbers", what, where, f"{advice[0].upper()}{advice[1:]}.", option=asking.option)


def _doubts(found: _Found, asking: Asking) -> tuple[Inferred, ...]:
    """Return a note why this numbering was chosen; () if there was no choice."""
    chosen, reason = found.chosen, found.reason
    is_doubtful = chosen != found.every[0] or reason is None
    if not (is_doubtful or len(found.every) > 1 or found.alike):
        return ()
    possible = (*found.agreeing, *(each for each in found.alike if each in found.fitting))
    others = [each.table for each in possible if each is not chosen]
    why = "their content does not show it" if reason is None else reason
    why += f"; if that is wrong, {asking.advice(*others)}" if others else ""
    return (Inferred("numbering", f"{asking.whose} numbers are read as {chosen.what}", why, is_doubtful),)


def _doubts_of_table(found: _Found, choice: ClassChoice, asking: Asking) -> tuple[Inferred, ...]:
    """Return a doubt if the masks look more like another table than like the named one."""
    chosen, shown = found.chosen, found.shown
    likelier = _other_tables(chosen, choice, shown) if chosen.source is found.every[0].source else []
    if not likelier:
        return ()
    looks = f"{asking.whose} numbers are read as {chosen.what}, but look like {' or '.join(likelier)}"
    best = _Reading(chosen.source, likelier[0], likelier[0])
    why = f"{_compared(best, [chosen], shown)}; if that is right, {asking.advice(*likelier)}"
    return (Inferred("numbering", looks, why),)


def other_numberings(choice: ClassChoice) -> str:
    """Return alternatives for a message to suggest, such as " or name --classes coco:90"."""
    table, base = choice.table or "", base_of(choice.table or "")
    others = [each for each in (*numberings_of(base), *_tables_like(base)) if each != table]
    return f", or name --classes {' or '.join(others)}" if others and table else ""


def _tables_like(table: str) -> tuple[str, ...]:
    return tuple(each for each in _ALIKE if each != table) if table in (*_ALIKE, "scannet200") else ()


def _readings(source: MaskSource, table: str) -> list[_Reading]:
    """Return all ways to read the masks with a table, the usual one first."""
    ways = [_Reading(source, each, each) for each in numberings_of(table)]
    has_stuff = source.kinds is not None and not all(source.kinds.values())
    if source.apart is not None and has_stuff and ways[0].table == numberings_of("coco")[0]:
        ways.append(_Reading(source.apart, ways[0].table, f"{ways[0].table} with stuff numbered apart from things"))
    return ways


def _disagreements(reading: _Reading, choice: ClassChoice, is_known: bool = False) -> list[str]:
    """Return how things and stuff in the files differ from those in the table, a text each. Classes of the user's own
    rows don't count, nor, if ``is_known``, numbers that the table lacks."""
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
    return wrong if base_of(reading.table) in _PANOPTIC or len(wrong) > len(kinds) / 2 else []


def _other_tables(chosen: _Reading, choice: ClassChoice, shown: _Shown) -> list[str]:
    """Return the other tables or numberings that indoor masks resemble most; none if the named one is as likely."""
    if shown.share(chosen, _SKIES) >= _SKY:
        return []
    likeness: dict[str, float] = {}
    for table in (each for base in TABLES for each in numberings_of(base)):
        other = _Reading(chosen.source, table, table)
        if _unknown(other, shown, choice) or _disagreements(other, choice):
            continue
        seen, share = _seen(other, shown), _usual(other, shown)
        is_usual = seen > min(2, len(other.usual) / 3) and share >= _OTHER_TABLE
        is_street, has_sky = base_of(other.table) == "cityscapes", shown.share(other, _SKIES) >= _SKY
        if is_usual and is_street == has_sky and _is_likelier(other, chosen, shown):
            likeness[table] = seen * share
    return [table for table, measure in likeness.items() if measure == max(likeness.values())]


def _told(readings: list[_Reading], choice: ClassChoice, shown: _Shown) -> tuple[_Reading, str | None, list[_Reading]]:
    """Return the reading that the masks point to, the reason (None if they are ambiguous), and all that fit."""
    if len(readings) == 1:
        return readings[0], "this alone fits what is a thing in the files", readings
    fitting = [each for each in readings if not _unknown(each, shown, choice)]
    if not shown.shares or not fitting:
        return readings[0], "no other fits", readings
    if len(fitting) == 1:
        numbers = sorted({number for each in readings for number in _unknown(each, shown, choice)})
        return fitting[0], f"this alone has the numbers {listed(numbers, 3)}", fitting
    # At any height: pictures may lie on their side, and a sky may fill them.
    is_indoors = shown.share(fitting[0], _SKIES, anywhere=True) < _SKY
    for best in fitting if is_indoors else fitting[:1]:
        others = [each for each in fitting if each is not best]
        if all(_is_likelier(best, other, shown) for other in others):
            return best, _compared(best, others, shown), fitting
    return fitting[0], None, fitting


def _compared(best: _Reading, others: list[_Reading], shown: _Shown) -> str:
    names, most = listed(sorted(best.usual), 3), max(_usual(each, shown) for each in others)
    return f"{_usual(best, shown):.0%} of the pixels are then {names}, and {most:.0%} otherwise"


def _is_likelier(one: _Reading, other: _Reading, shown: _Shown) -> bool:
    """Whether the pixels whose class differs between two readings make the first likelier."""
    same = {number for number in shown.shares if one.names.get(number) == other.names.get(number)}
    telling = replace(shown, shares={n: share for n, share in shown.shares.items() if n not in same})
    own = _usual(one, telling)
    return own >= _ENOUGH and own * _seen(one, telling) >= _TIMES * _usual(other, telling) * _seen(other, telling)


def _usual(reading: _Reading, shown: _Shown) -> float:
    """Return which fraction of the pixels has one of the reading's ``usual`` classes."""
    return shown.share(reading, reading.usual)


def _seen(reading: _Reading, shown: _Shown) -> int:
    """Return how many of the reading's ``usual`` classes fill at least _SEEN of all pixels."""
    return sum(shown.share(reading, {name}) >= _SEEN for name in reading.usual)


def _shown(source: MaskSource, choice: ClassChoice) -> _Shown:
    """Return the statistics of some frames, without the numbers that mean void. 0 is taken as void only if no other
    void number occurs in them."""
    names, counts, upper = list(source.masks), Counter[int](), Counter[int]()
    for name in evenly_spread(names, _LOOKED_AT):
        try:
            found = source.masks[name].read()
        except PlgsError:  # the later reader reports the error
            continue
        for counted, ids in ((counts, found.ids), (upper, found.ids[: len(found.ids) // 2])):
            pixels = dict(enumerate(np.bincount(ids.ravel()).tolist()))
            for one in found.segments:
                counted[one.label] += pixels.get(one.id, 0)
    void = choice.void | source.void
    if any(counts[number] for number in void - {0}):
        void -= {0}
    kept = {number: count for number, count in counts.items() if count and number not in void}
    shares = {number: count / sum(kept.values()) for number, count in kept.items()}
    return _Shown(shares, {number: upper[number] / count for number, count in kept.items()})


def _unknown(reading: _Reading, shown: _Shown, choice: ClassChoice) -> set[int]:
    """Return the masks' numbers to which neither this reading nor the user's rows of ``choice`` give a meaning."""
    table = known_table(reading.table)
    known = {label.id for label in table.labels} | table.void | reading.source.void
    return {*shown.shares} - known - {row.id for row in choice.rows if row.id is not None}
