"""The classes of masks: what each number in their files means, and each class's colour."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from pathlib import Path

from ..errors import PlgsError
from ..posed.classes import PALETTE, VOID, Category, ClassLabel, ClassTable, named
from ..posed.layout import listed
from .class_choice import FILE_NAME, ClassChoice, ClassRow
from .class_tables import REDUCED, known_table, reduced_by_name

_FIRST, _OTHERS = ("reduced", "nyu40"), ("nyu13", "scannet200", "replica", "coco", "ade20k", "cityscapes")
"""Tables whose names take colours, most distinct first: the first in this order, the others' by how many share them."""
_CALM = {"wall": 24, "floor": 21, "ceiling": 26}  # palette indices of greys, for what fills most pictures
_FAR = 128  # the number of leading palette colours that differ by at least 9.5 (CIEDE2000); the rest differ by 5.5


def coloured(labels: Iterable[ClassLabel]) -> ClassTable:
    """Return the table of ``labels`` in ascending order of id. Labels with a colour keep it, names of public tables
    have fixed colours, and others get one by a hash, among the first `_FAR` or the next free one. Raises ValueError."""
    labels = sorted(labels, key=lambda label: label.id)
    indices = _palette_indices()
    chosen = {label.id: label.colour for label in labels if label.colour is not None}
    unknown = []
    for label in labels:
        index = next((indices[word] for word in _words(label.name) if word in indices), None)
        if index is None:
            unknown.append(label)
        else:
            chosen.setdefault(label.id, PALETTE[index])
    free = {*PALETTE}.difference(chosen.values())
    for label in sorted(unknown, key=lambda label: _words(label.name)):  # by name: ids do not decide who is first
        first = int.from_bytes(sha256(_words(label.name)[0].encode()).digest()[:4], "big") % _FAR  # hash() is salted
        in_turn = (*PALETTE[first:_FAR], *PALETTE[:first], *PALETTE[_FAR:]) if free else ()
        colour = chosen.setdefault(label.id, next((each for each in in_turn if each in free), PALETTE[first]))
        free.discard(colour)
    return ClassTable(tuple(Category(each.id, each.name, each.is_thing, chosen[each.id]) for each in labels))


@cache
def _palette_indices() -> dict[str, int]:
    """The palette index of every name in a public table."""
    first, others = ([_words(label.name)[0] for table in tables for label in known_table(table).labels]
                     for tables in (_FIRST, _OTHERS))  # fmt: skip
    by_tables = sorted(dict.fromkeys(others), key=lambda name: -others.count(name))
    names = list(dict.fromkeys([*first, *by_tables]))
    for name, index in _CALM.items():
        names[names.index(name)], names[index] = names[index], name
    return {name: index for index, name in enumerate(names)}


def plain_name(name: str) -> str:
    """Return a class name normalised for look-up."""
    return " ".join(name.casefold().replace("-", " ").replace("_", " ").split())


def _words(name: str) -> tuple[str, ...]:
    """Return the ``plain_name`` of a name, then that of each of its synonyms ("road, route")."""
    return plain_name(name), *(word.strip() for word in plain_name(name).split(","))


OBJECT = ClassLabel(0, "object", is_thing=True)


@dataclass(frozen=True)
class ClassMap:
    """What the labels of masks mean: ``class_of`` maps them to ids in ``classes``, 0 = void; ``others`` is the class id
    of any other label, None if that is an error. ``merges``: several labels may have one class."""

    classes: ClassTable
    class_of: Mapping[int, int]
    others: int | None = None
    merges: bool = False


@dataclass(frozen=True)
class NamedClass:
    """One row of a class list that a user edits: a ``label`` of the masks, its ``name``, and whether it is a thing.
    ``into`` names the class that it counts as: its own, another to merge it, or "void" to drop it."""

    label: int
    name: str
    into: str
    is_thing: bool


def class_map(
    labels: Sequence[ClassLabel] | None, choice: ClassChoice | None, where: Path, objects: bool,
    more: Sequence[ClassLabel] = (),
) -> ClassMap:  # fmt: skip
    """The classes of masks whose files have ``labels`` (None: no classes), after the user's ``choice``. ``more`` are
    classes of detections that no table lists. A table that uses the number 0, which is void here, is shifted by one as
    a whole. With ``objects``, labels number objects; those without a name get the class "object". Raises PlgsError if
    several labels have a name."""
    choice = choice or ClassChoice()
    labels = (*((labels if choice.labels is None else choice.labels) or ()), *more)
    rows = _numbered(labels, choice)
    own = _labels(labels, rows, choice)
    if not own and not objects:
        fix = f'Write {FILE_NAME} beside them, such as table = "nyu40", or name a table with --classes.'
        raise PlgsError("no-class-names", "the masks do not say what their classes are", where, fix, option="--classes")
    into = _targets(own, rows, choice)
    if choice.to_reduced:
        final, class_of = _reduced(own, into, choice)
    else:
        final, class_of = _merged(own, into, choice)
    for number in {*choice.void, *(() if choice.table is None else known_table(choice.table).void - own.keys())}:
        class_of[number] = VOID
    others = None
    if objects:
        others = max((each.id for each in final), default=0) + 1  # after all others, whose ids stay
        final = [*final, replace(OBJECT, id=others)]
    used = [number for number in class_of.values() if number != VOID]
    merges = len(set(used)) < len(used)
    colours = {class_of[number]: row.rgb for number, row in rows if row.rgb}
    classes = coloured(replace(each, colour=colours.get(each.id, each.colour)) for each in final)
    return ClassMap(classes, class_of, others, merges)


def named_classes(labels: Sequence[ClassLabel], choice: ClassChoice | None) -> list[NamedClass]:
    """The classes of masks as an editable list, in order of their numbers. Raises PlgsError for unknown names."""
    known = class_map(labels, choice, Path(FILE_NAME), objects=False)
    choice = choice or ClassChoice()
    labels = labels if choice.labels is None else choice.labels
    own, rows = _labels(labels, _numbered(labels, choice), choice), []
    for number, label in sorted(own.items()):
        class_id = known.class_of.get(number, VOID)
        target = None if class_id == VOID else known.classes[class_id]
        into, is_thing = ("void", label.is_thing) if target is None else (target.name, target.is_thing)
        rows.append(NamedClass(number, label.name, into, is_thing))
    return rows


def choice_of(rows: Sequence[NamedClass], void: frozenset[int] = frozenset()) -> ClassChoice:
    """The class choice (a classes.toml) for an edited list of classes. It names no table: each row has a number."""
    return ClassChoice(
        void=void,
        rows=tuple(
            ClassRow(row.label, row.name, row.is_thing, row.into if row.into and row.into != row.name else None)
            for row in rows
        ),
    )


def _numbered(labels: Sequence[ClassLabel], choice: ClassChoice) -> list[tuple[int, ClassRow]]:
    """Return the choice's rows, each with its label's number. Raises PlgsError for an unknown or ambiguous name."""
    names, rows = {label.id: label.name for label in labels}, []
    for row in choice.rows:
        number = row.id if row.id is not None else _only(names, row.name or "", choice)
        if number is None:
            fix = "Correct the name, or give its number in the masks as id."
            what = f'the masks have no class called "{row.name}"'[:90]
            raise PlgsError("no-such-class", what, choice.path or FILE_NAME, fix)
        rows.append((number, row))
    return rows


def _only(names: Mapping[int, str], text: str, choice: ClassChoice) -> int | None:
    """Return the number whose name is ``text``, or None. Raises PlgsError (about ``choice``) if several have it."""
    found = named(names, text)
    if len(found) > 1:
        what = f'several classes have names that differ from "{text}" only in capitals ({listed(found)})'
        fix = "Write it as one of them does, or give them other names by their numbers as id."
        if names[found[0]] == text:
            what = f'several classes are called "{text}" ({listed(found)})'
            fix = f'Join them: for one of them write into = "{text}" with its number as id. Or give it another name.'
        raise PlgsError("class-twice", what, choice.path or FILE_NAME, fix)
    return found[0] if found else None


def _labels(
    labels: Sequence[ClassLabel], rows: Sequence[tuple[int, ClassRow]], choice: ClassChoice
) -> dict[int, ClassLabel]:
    """Return the labels by number, with the names and kinds (thing or stuff) that the choice's rows give them."""
    found = {label.id: label for label in labels}
    for number, row in rows:
        known = found.get(number)
        if known is None:
            if row.name is None:
                what = f"the class {number} has no name"
                raise PlgsError("class-unnamed", what, choice.path or FILE_NAME, "Add name and thing to its [[class]].")
            found[number] = ClassLabel(number, row.name, row.thing is not False)  # a thing by default
        else:
            name = known.name if row.name is None or row.id is None else row.name  # without an id, its name was the key
            found[number] = replace(known, name=name, is_thing=known.is_thing if row.thing is None else row.thing)
    return found


def _targets(
    labels: Mapping[int, ClassLabel], rows: Sequence[tuple[int, ClassRow]], choice: ClassChoice
) -> dict[int, str]:
    """Return the name of the class into which ``rows`` merge a label, by its number, without labels not merged."""
    names, into = {number: label.name for number, label in labels.items()}, {}
    for number, row in rows:
        found = [] if row.into is None else named(names, row.into)
        if row.into is None or found == [number] or (choice.to_reduced and number in found):
            continue  # it stays what it is
        if number in found and names[number] != row.into:
            _only(names, row.into, choice)  # only to raise if the name is ambiguous
        into[number] = row.into
    return into


def _merged(
    labels: Mapping[int, ClassLabel], into: Mapping[int, str], choice: ClassChoice
) -> tuple[list[ClassLabel], dict[int, int]]:
    """Merge labels ``into`` classes, named by label. Returns the remaining classes in order of id, and each label's
    class id. Raises PlgsError if several classes have such a name."""
    shift = 1 if 0 in labels else 0  # 0 is void here, so all move up by one
    class_of = {number: number + shift for number in labels if number not in into}
    final = {class_id: replace(labels[number], id=class_id) for number, class_id in class_of.items()}
    names = {class_id: label.name for class_id, label in final.items()}
    for number, name in sorted(into.items()):  # a new name gets the id of its first label
        if name.casefold() == "void":
            class_of[number] = VOID
            continue
        target = _only(names, name, choice)
        if target is None:
            names[target := number + shift] = name
            final[target] = replace(labels[number], id=target, name=name)
        class_of[number] = target
    return [final[class_id] for class_id in sorted(final)], class_of


def _reduced(
    labels: Mapping[int, ClassLabel], into: Mapping[int, str], choice: ClassChoice
) -> tuple[list[ClassLabel], dict[int, int]]:
    """Return the paper's 21 classes, and by number each label's class among them: the one that ``into`` names, else
    that of its number in the table of ``choice``, else of its name. Raises PlgsError for labels without a match."""
    final = list(known_table(REDUCED).labels)
    by_name = {label.name: label.id for label in final} | {"void": VOID}
    table = {} if choice.table is None else known_table(choice.table).reduced
    class_of: dict[int, int] = {}
    unplaced = []
    for number, label in labels.items():
        name = into.get(number)
        class_id = by_name.get(name.casefold()) if name is not None else table.get(number, reduced_by_name(label.name))
        if class_id is None:
            unplaced.append(name or label.name)
        else:
            class_of[number] = class_id
    if unplaced:
        what = f"classes have no place among the paper's 21 ({listed(unplaced)})"
        raise PlgsError("unplaced", what, choice.path or FILE_NAME, "Use into to say which class each counts as.")
    return final, class_of
