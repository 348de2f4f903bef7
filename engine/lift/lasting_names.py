"""Keeps ids and names of an earlier lift of the same scene for objects that are still there. result/names.json lists
what changed, and the ids and numbers that later lifts must not use again."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..corrections import Edit, read_edits
from ..errors import PlgsError
from ..instances.lasting_objects import LastingObjects, lasting_objects, object_overlap
from ..instances.records import SceneObject
from ..job import EventWriter, LiftFolder, LiftRequest, read_manifest, write_atomically
from ..json_file import read_object
from ..model.structured import StructuredScene
from ..posed.classes import LARGEST_ID
from ..presets.preset import Preset
from ..result_files import INSTANCES, SEMANTIC_POINTS, SemanticPoints, read_arrays, read_instances
from ..scene import ClassTable
from .preparation import PreparedLift

log = logging.getLogger("plgs.names")

FORMAT = 1
NAMES = "names.json"
MOST_NEW = 1 << 13
"""The number of ids that must remain for new objects. No room has so many."""
LARGEST_NUMBER = 10**9
"""The largest number in an object's name, as in "chair 3"."""
_FIX = "Name another finished lift with --names-from, or none."


@dataclass(frozen=True, eq=False)
class EarlierLift:
    """What the earlier lift found. ``names`` and ``class_names`` of the objects by id. ``xyz`` float32 [N, 3]: points
    in metres, with ``instance_id`` int32 [N], 0 = none. ``largest_id`` and ``last_numbers`` (by class name): the
    largest used so far, also by lifts before it. ``edits``: its corrections."""

    folder: Path
    names: Mapping[int, str]
    class_names: Mapping[int, str]
    xyz: NDArray[np.float32]
    instance_id: NDArray[np.int32]
    largest_id: int
    last_numbers: Mapping[str, int]
    edits: tuple[Edit, ...] = ()


def refuse_names_of_no_objects(request: LiftRequest, preset: Preset) -> None:
    """Raise PlgsError if the request asks for an earlier lift's names, but the preset makes no objects."""
    if request.names_from is not None and preset.objects == "none":
        fix = 'Leave out --names-from, or set objects to "agreement" or "boxes".'
        what = 'with objects = "none" there are no objects whose names could be kept'
        raise PlgsError("names-of-no-objects", what, request.names_from, fix, option="--names-from")


def read_earlier(folder: Path) -> EarlierLift:
    """Read the objects of the finished lift in ``folder``. Raises PlgsError if there is none, or it cannot be read."""
    lift = LiftFolder.open(folder)
    result = lift.result_path
    read_manifest(result)
    try:
        _, listed = read_instances(result / INSTANCES)
        points = read_arrays(result / SEMANTIC_POINTS, SemanticPoints)
        history: Any = read_object(result / NAMES, _FIX) if (result / NAMES).exists() else {}
        numbers = {str(kind): int(number) for kind, number in history.get("last_numbers", {}).items()}
        edits = read_edits(lift.path)
        ids = [*(one.id for one in listed), *(edit.largest_id for edit in edits)]
        before = int(history.get("largest_id", 0))
        largest = max(before, *ids, 0)
        if unknown := {*np.unique(points.instance_id).tolist()} - {0, *(one.id for one in listed)}:
            raise ValueError(f"{INSTANCES} lacks the object {min(unknown)} of {SEMANTIC_POINTS}")
        # No lift has other ids and numbers, or they leave none for new objects.
        for given, most in (((before, largest), LARGEST_ID - MOST_NEW), (numbers.values(), LARGEST_NUMBER)):
            if wrong := [number for number in given if not 0 <= number <= most]:
                raise ValueError(f"{wrong[0]} is not a number from 0 to {most}")
    except (PlgsError, OSError, KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        what = f"the names of the earlier lift cannot be read ({error})"
        raise PlgsError("names-unreadable", what, result, _FIX, option="--names-from") from error
    names, class_names = {one.id: one.name for one in listed}, {one.id: one.class_name for one in listed}
    numbers = dict.fromkeys(class_names.values(), 0) | numbers
    edited = [name for edit in edits for name in (*edit.names, *(one.name for one in edit.made))]
    for kind, _, digits in (name.rpartition(" ") for name in (*names.values(), *edited)):  # "chair", "3"
        if kind and digits.isdecimal() and len(digits) < len(str(LARGEST_NUMBER)):
            numbers[kind] = max(numbers.get(kind, 0), int(digits))
    return EarlierLift(lift.path, names, class_names, points.xyz, points.instance_id, largest, numbers, edits)


@dataclass(frozen=True)
class LastingNames:
    """Lasting names. ``id_of``: each matched id's final id. ``names``: by final id. ``changes``: for names.json."""

    id_of: dict[int, int]
    names: dict[int, str]
    changes: dict[str, Any]


def lasting_names(
    earlier: EarlierLift,
    instances: Sequence[SceneObject],
    xyz: NDArray[np.floating],
    instance_of_point: NDArray[np.int32],
    classes: ClassTable,
) -> LastingNames:
    """Match ``instances`` with the earlier lift's objects by their points ``xyz`` [N, 3], metres, whose object
    ``instance_of_point`` gives ([N], 0 = none). Matches keep their ids and, if of the same class, their names."""
    overlap = object_overlap(earlier.xyz, earlier.instance_id, xyz, instance_of_point)
    found = lasting_objects(overlap)
    id_of, names, numbers, next_id = {}, {}, dict(earlier.last_numbers), earlier.largest_id
    for one in sorted(instances, key=lambda instance: instance.id):
        kind, old = classes[one.class_id].name, found.old_of.get(one.id)
        if old is None:
            next_id += 1
        id_of[one.id] = shown = next_id if old is None else old
        if old is not None and earlier.class_names.get(old) == kind:
            names[shown] = earlier.names[old]
        else:
            numbers[kind] = numbers.get(kind, 0) + 1
            names[shown] = f"{kind} {numbers[kind]}"
    changes = _changes(earlier, found, id_of, names)
    changes |= {"largest_id": next_id, "last_numbers": numbers}
    return LastingNames(id_of, names, changes)


def _changes(
    earlier: EarlierLift, found: LastingObjects, id_of: Mapping[int, int], names: Mapping[int, str]
) -> dict[str, Any]:
    def entry(shown: int) -> dict[str, Any]:
        return {"id": shown, "name": names[shown]}

    kept = {id_of[new]: old for new, old in found.old_of.items() if new in id_of}
    same = [shown for shown, old in kept.items() if names[shown] == earlier.names[old]]
    gone = sorted(set(earlier.names) - set(kept.values()))
    into = {old: id_of[new] for old, new in found.merged.items() if new in id_of}
    parts = {id_of[new]: old for new, old in found.parts.items() if new in id_of}
    return {
        "format": FORMAT,
        "from": str(earlier.folder),
        "kept": [entry(shown) for shown in sorted(same)],
        "renamed": [entry(shown) | {"was": earlier.names[shown]} for shown in sorted(set(kept) - set(same))],
        "new": [entry(i) | ({"part_of": parts[i]} if i in parts else {}) for i in sorted(set(names) - set(kept))],
        "gone": [
            {"id": old, "name": earlier.names[old]} | ({"merged_into": into[old]} if old in into else {})
            for old in gone
        ],
    }


def keep_names(
    earlier: EarlierLift, prepared: PreparedLift, seen: NDArray[np.bool_], lifted: StructuredScene, classes: ClassTable
) -> tuple[PreparedLift, LastingNames]:
    """Return the ``prepared`` lift with the ids of the earlier lift's objects, and these objects' names. ``lifted`` is
    renumbered in place. Only points with ``seen`` bool [N] are compared, since the earlier lift stored no others."""
    points = prepared.instance_of_point
    lasting = lasting_names(earlier, prepared.instances, prepared.cloud.xyz[seen], points[seen], classes)
    id_of = lasting.id_of
    table = np.zeros(max(id_of, default=0) + 1, np.int32)
    for one, shown in id_of.items():
        table[one] = shown
    channels = lifted.channels
    lifted.channels = replace(channels, slot_ids=tuple(id_of.get(slot, slot) for slot in channels.slot_ids))
    kinds = prepared.class_of_instance
    renamed = replace(
        prepared,
        instances=[replace(one, id=id_of[one.id]) for one in prepared.instances],
        instance_of_point=table[points],
        class_of_instance=None if kinds is None else {id_of[one]: kind for one, kind in kinds.items()},
    )
    return renamed, lasting


def write_names(folder: LiftFolder, lasting: LastingNames, events: EventWriter) -> None:
    """Write result/names.json and report how many objects kept, changed or lost their names. Raises OSError."""
    write_atomically(folder.result_path / NAMES, json.dumps(lasting.changes, indent=1, ensure_ascii=False) + "\n")
    counts = {kind: len(lasting.changes[kind]) for kind in ("kept", "renamed", "new", "gone")}
    events.metric("names", counts)
    events.artifact(folder.result_path / NAMES, "names")
    log.info("names from %s: %s", lasting.changes["from"], counts)
    for kind in ("renamed", "new", "gone"):
        for one in lasting.changes[kind]:
            log.info("%s: %s", kind, ", ".join(f"{key} {value}" for key, value in one.items()))
    if not counts["kept"] and lasting.changes["gone"]:
        events.warning("no object is where the earlier lift had one: was it lifted from the same scene?")
