"""Make edits of the objects that exist now. Each edit is checked before it is made. All functions take the current
state after all edits (``Replay``), and raise PlgsError for an edit that makes no sense."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError, did_you_mean
from ..posed.classes import ClassTable, named
from ..posed.layout import listed
from .edits import Edit, MovedPoints, NewObject, ObjectMark
from .fills import cell_keys, with_neighbours
from .relabelling import Labels, nearest
from .replay import Replay, in_millimetres

PART_GAP = 0.15
"""The largest distance in metres between neighbouring points of one part."""
LEAST_PART = 0.02
"""Share of an object's points below which a part is a crumb, which stays with the nearest larger part."""
AROUND = 0.5
"""Metres around a deleted object within which its points look for a new label."""
_LONGEST_NAME = 60
"""Characters. Blender's own names have no more bytes than that, and a Latin letter takes one."""


def rename(state: Replay, number: int, name: str) -> Edit:
    name = name.strip()
    if not name or len(name) > _LONGEST_NAME or not name.isprintable():
        what = f"{name[:80]!r} is not a name for an object"
        raise PlgsError("object-name", what, "", f"Give 1 to {_LONGEST_NAME} printable characters.")
    return Edit("rename", (_mark(state, number),), name=name)


def class_of(classes: ClassTable, said: int | str) -> int:
    """Return the class that ``said`` names: number, unique name or both ("3 chair"). Raises PlgsError if none fits."""
    names, text = {one.id: one.name for one in classes.categories}, str(said).strip()
    found = named(names, text) if isinstance(said, str) else []
    found = found or [number for number, name in names.items() if text in (str(number), f"{number} {name}")]
    if len(found) != 1:
        what = f"'{said}' may be the class {' or '.join(f'{one} {names[one]}' for one in found)}"
        every = ", ".join(f"{number} {name}" for number, name in names.items())
        fix = f"{did_you_mean(text, names.values())}The classes are {every}."
        raise PlgsError("no-class", what if found else f"there is no class {said}", "", fix)
    return found[0]


def object_of(state: Replay, said: int | str) -> int:
    """Return the object that ``said`` names: id, unique name or both ("7 chair 1"). Raises PlgsError if none fits."""
    names, text = {number: one.name for number, one in state.objects.items()}, str(said).strip()
    found = [number for number, name in names.items() if text in (str(number), f"{number} {name}")]
    found = found or named(names, text)
    if not found:
        raise _no_object(state, said)
    if len(found) > 1:
        what = f"several objects are named '{said}': {', '.join(map(str, found))}"
        raise PlgsError("several-objects", what, "", "Give the id of one, as shown by list.")
    return found[0]


def reclass(state: Replay, numbers: Sequence[int], said: int | str) -> Edit:
    """Give the objects ``numbers`` the class ``said``, its number or name; names that nobody gave follow it. With a
    stuff class these objects end, and their points get only the class."""
    class_id, numbers = class_of(state.classes, said), _some(numbers)
    marks = tuple(_mark(state, number) for number in numbers)
    if not state.classes[class_id].is_thing:
        return Edit("assign", marks, rest=-class_id)
    return Edit("reclass", marks, names=_names_as(state, numbers, class_id), class_id=class_id)


def merge(state: Replay, numbers: Sequence[int]) -> Edit:
    """Merge the objects ``numbers`` into the first, which keeps its name and its class."""
    numbers = list(dict.fromkeys(numbers))
    if len(numbers) < 2:
        raise PlgsError("merge-one", "an object cannot be merged with itself", "", "Name two or more objects.")
    return Edit("merge", tuple(_mark(state, number) for number in numbers))


def delete(state: Replay, number: int, *, around: bool = True) -> Edit:
    """Delete object ``number``. Its points get the labels ``around`` them or, if that is False, its class alone."""
    mark = _mark(state, number)
    xyz, other = state.points_of(number), (state.label != number) & (state.label != 0)
    moved: tuple[MovedPoints, ...] = ()
    if around and len(xyz):
        near = ((state.xyz >= xyz.min(axis=0) - AROUND) & (state.xyz <= xyz.max(axis=0) + AROUND)).all(axis=1)
        rows = np.flatnonzero(near & other)
        if len(rows):
            moved = _groups(xyz, state.label[rows[nearest(xyz, state.xyz[rows])[0]]])
    return Edit("delete", (mark,), moved=moved, rest=-state.class_of(number))


def remove(state: Replay, numbers: Sequence[int], fill: str, digest: str) -> Edit:
    """Take the objects ``numbers`` out of the room. The file ``fill``, with the SHA-256 ``digest``, replaces them."""
    return Edit("remove", tuple(_mark(state, number) for number in _some(numbers)), fill=fill, digest=digest)


def split(
    state: Replay, number: int, part: NDArray[np.integer], first_id: int, class_of: Mapping[int, int] | None = None
) -> Edit:
    """Split object ``number``. ``part`` int [n] is the part of each of its points in their order, 0 for what stays. The
    other parts become new objects with ids from ``first_id`` on. ``class_of`` gives a part's class, by default the
    object's. Raises PlgsError if only one part would result."""
    mark, one = _mark(state, number), state.objects[number]
    parts = [int(each) for each in np.unique(part)]
    class_of = {each: kind for each, kind in (class_of or {}).items() if kind != one.class_id}
    if len(parts) < 2:
        fix = "Split it by a plane, or by points that you choose."
        raise PlgsError("split-one-part", f"object {number} ({one.name}) has only one part", "", fix)
    kept, *parts = parts
    kinds, own = [class_of.get(each, one.class_id) for each in parts], class_of.get(kept, 0)
    names = _names_as(state, [number], own) if own else ()
    before = [own] if any(names) else []
    made = tuple(
        NewObject(first_id + index, _new_name(state, kind, [*before, *kinds[:index]].count(kind)), kind)
        for index, kind in enumerate(kinds)
    )
    label = np.full(len(part), number, np.int32)
    for new, each in zip(made, parts, strict=True):
        label[part == each] = new.id
    moves = label != number
    moved = _groups(state.points_of(number)[moves], label[moves])
    return Edit("split", (mark,), names=names, class_id=own, made=made, moved=moved)


def parts_of(xyz: NDArray[np.floating], gap: float = PART_GAP) -> NDArray[np.int64]:
    """Return the connected part of each point [n, 3], int64 [n]; the largest is 0. Points are connected if the cells
    that they lie in, with sides of half of ``gap`` metres, touch. Tiny parts are joined to the nearest part."""
    if not len(xyz):
        return np.zeros(0, np.int64)
    cells, cell = np.unique(np.floor(xyz / (gap / 2)).astype(np.int64), axis=0, return_inverse=True)
    keys, component = cell_keys(cells), np.arange(len(cells))  # both rise
    pairs = list[NDArray[np.int64]]()
    for step in with_neighbours(np.zeros((1, 3), np.int32)):
        beside = cell_keys(cells + step)
        at = np.minimum(np.searchsorted(keys, beside), len(keys) - 1)
        pairs.append(np.stack([np.arange(len(keys)), at])[:, keys[at] == beside])
    one, other = np.concatenate(pairs, axis=1)
    while (component[one] != component[other]).any():
        np.minimum.at(component, one, component[other])
        component = component[component]
    _, component, sizes = np.unique(component[cell.ravel()], return_inverse=True, return_counts=True)
    part = np.argsort(np.argsort(-sizes, kind="stable"))[component]
    large = np.sort(sizes)[::-1] >= min(LEAST_PART * len(xyz), sizes.max())  # the largest is no crumb
    crumbs = ~large[part]
    if crumbs.any():
        part[crumbs] = part[~crumbs][nearest(xyz[crumbs], xyz[~crumbs])[0]]
    return part


def sides_of(xyz: NDArray[np.floating], point: Sequence[float], normal: Sequence[float]) -> NDArray[np.int64]:
    """Return 1 for points [n, 3] beyond the plane through ``point``, the way ``normal`` leads, else 0; int64 [n]."""
    return ((xyz - np.asarray(point)) @ np.asarray(normal, np.float64) > 0).astype(np.int64)


def assign(
    state: Replay, chosen: NDArray[np.bool_], target: int, *, class_id: int = 0, name: str = "", new_id: int = 0
) -> Edit:
    """Give the ``chosen`` points, bool [N], to the object ``target``; if that is 0, to a new object ``new_id`` of the
    class ``class_id``, called ``name`` ("": a made name). If both ids are 0, give them only the class."""
    made: tuple[NewObject, ...] = ()
    if not chosen.any():
        raise PlgsError("no-points", "no points are chosen", "", "Select points, or enlarge the region.")
    if target:
        _mark(state, target)
        label = target
    elif class_of(state.classes, class_id) and new_id:
        made = (NewObject(new_id, name or _new_name(state, class_id), class_id),)
        label = new_id
    else:
        label = -class_id
    before = np.unique(state.label[chosen])
    marks = tuple(state.mark(one) for one in before.tolist() if one > 0 and one != label)
    classes = tuple(-one for one in before.tolist() if one <= 0 and one != label)
    rows = chosen & (state.label != label)
    if not rows.any():
        raise PlgsError("same-points", "no chosen point would change object or class", "", "Choose others.")
    moved = _groups(state.xyz[rows], np.full(int(rows.sum()), label, np.int32))
    return Edit("assign", marks, classes=classes, moved=moved, made=made)


def crop(state: Replay, number: int, within: NDArray[np.bool_]) -> Edit:
    """Give object ``number`` exactly the points ``within``, bool [N], that are its own or have its class but no object.
    Its points outside keep the class but lose the object. Raises PlgsError if nothing changes."""
    mark, kind = _mark(state, number), state.class_of(number)
    own = state.label == number
    inner, outer = within & (state.label == -kind), own & ~within
    if not (own & within).any() and not inner.any():
        what = f"no point of {state.objects[number].name} is in the box"
        raise PlgsError("crop-empty", what, "", "Move its box back.")
    if not inner.any() and not outer.any():
        what = "the object already has exactly the points in its box"
        raise PlgsError("crop-same", what, "", "Move or scale its box.")
    rows = inner | outer
    label = np.where(inner, number, -kind).astype(np.int32)
    return Edit("assign", (mark,), classes=(kind,), moved=_groups(state.xyz[rows], label[rows]))


def accept(state: Replay, numbers: Sequence[int]) -> Edit:
    return Edit("accept", tuple(_mark(state, number) for number in _some(numbers)))


def _no_object(state: Replay, said: int | str) -> PlgsError:
    gone = [one for number, one in state.removed.items() if str(said).strip() in (str(number), one.name)]
    if gone:
        return PlgsError("removed-already", f"{gone[0].name} is removed already", "", "Put it back first.")
    now = state.objects.get(state.owners.get(str(said).strip(), 0))
    hint = did_you_mean(str(said), (one.name for one in state.objects.values()))
    hint = hint if now is None else f"It is called {now.name} now. "
    known = listed((f"{number} {one.name}" for number, one in sorted(state.objects.items())), 40)
    fix = f"{hint}The lift has {known or 'none'}, as 'correct LIFT list' shows."
    return PlgsError("no-object", f"there is no object {said}", "", fix)


def _mark(state: Replay, number: int) -> ObjectMark:
    if number not in state.objects:
        raise _no_object(state, number)
    return state.mark(number)


def _some(numbers: Sequence[int]) -> list[int]:
    if not numbers:
        raise PlgsError("no-object-named", "no object is named", "", "Name one or more objects.")
    return list(dict.fromkeys(numbers))


def _new_name(state: Replay, class_id: int, more: int = 0) -> str:
    """Return a name such as "chair 7", which no object had before. ``more`` numbers are skipped."""
    kind = state.classes[class_id].name
    names = [name.removeprefix(f"{kind} ") for name in state.owners]
    return f"{kind} {max((int(name) for name in names if name.isdecimal()), default=0) + 1 + more}"


def _names_as(state: Replay, numbers: Sequence[int], class_id: int) -> tuple[str, ...]:
    """Return new names for objects that get a class, "" for one that keeps its own: a person's, or the class's."""
    names, others = list[str](), {one.name for one in state.classes.categories if one.id != class_id}
    for number in numbers:
        kind, _, digits = state.objects[number].name.rpartition(" ")
        is_made = digits.isdecimal() and kind in others and number not in state.renamed
        names.append(_new_name(state, class_id, len(names) - names.count("")) if is_made else "")
    return tuple(names)


def _groups(xyz: NDArray[np.float32], label: Labels) -> tuple[MovedPoints, ...]:
    kept = in_millimetres(xyz)
    return tuple(MovedPoints(one, tuple(kept[label == one].ravel().tolist())) for one in np.unique(label).tolist())
