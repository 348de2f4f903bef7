"""Names that last: a lift of a scene that was lifted before keeps the ids and names of the objects still there.

What changed is written to result/names.json, with what the next lift must not use again.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..instances import GlobalInstance, LastingObjects, lasting_objects, object_overlap
from ..job import EventWriter, JobError, LiftFolder, read_manifest, write_atomically
from ..job.json_file import read_object
from ..model.structured import StructuredScene
from ..scene import ClassTable, SceneError
from ..scene.array_file import read_npz
from .preparation import PreparedLift

log = logging.getLogger("plgs.names")

FORMAT = 1
NAMES = "names.json"
_FIX = "Name another finished lift with --names-from, or none."


@dataclass(frozen=True, eq=False)
class EarlierLift:
    """``names`` and ``class_names`` by instance id; points ``xyz`` float32 [N, 3] in metres with ``instance_id`` int32
    [N] (0 = none); ``largest_id`` and ``last_numbers`` (by class name) of it and of those before."""

    folder: Path
    names: Mapping[int, str]
    class_names: Mapping[int, str]
    xyz: NDArray[np.float32]
    instance_id: NDArray[np.int32]
    largest_id: int
    last_numbers: Mapping[str, int]


def read_earlier(folder: Path) -> EarlierLift:
    """Raises JobError when it is no finished lift, or cannot be read."""
    lift = LiftFolder.open(folder)
    result = lift.result_path
    read_manifest(result)
    try:
        records: Any = read_object(result / "instances.json", _FIX)["instances"]
        points = read_npz(result / "semantic_points.npz", _FIX, ("xyz", "instance_id"))
        xyz, instance_id = points["xyz"], points["instance_id"]
        if xyz.dtype != np.float32 or xyz.shape[1:] != (3,) or instance_id.shape != xyz.shape[:1]:
            raise ValueError("the points have another shape")
        names = {int(one["id"]): str(one["name"]) for one in records}
        kinds = {int(one["id"]): str(one["class_name"]) for one in records}
        history: Any = read_object(result / NAMES, _FIX) if (result / NAMES).exists() else {}
        numbers = {str(kind): int(number) for kind, number in history.get("last_numbers", {}).items()}
        largest = max([int(history.get("largest_id", 0)), *names])
    except (SceneError, OSError, KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise JobError(f"the names of the earlier lift cannot be read ({error})", result, _FIX) from error
    for one, name in names.items():
        kind = kinds[one]
        numbers[kind] = max(numbers.get(kind, 0), _number(name, kind))
    return EarlierLift(lift.path, names, kinds, xyz, instance_id, largest, numbers)


@dataclass(frozen=True)
class LastingNames:
    """``id_of`` maps the ids of the matching to those that the result shows; ``names`` are by the latter. ``changes``
    is what names.json tells."""

    id_of: dict[int, int]
    names: dict[int, str]
    changes: dict[str, Any]


def lasting_names(
    earlier: EarlierLift,
    instances: Sequence[GlobalInstance],
    xyz: NDArray[np.floating],
    instance_of_point: NDArray[np.int32],
    classes: ClassTable,
) -> LastingNames:
    """Objects that are still there keep their ids, and their names where their class is the same. New ones are numbered
    after all that ever were."""
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
    def told(shown: int) -> dict[str, Any]:
        return {"id": shown, "name": names[shown]}

    kept = {id_of[new]: old for new, old in found.old_of.items() if new in id_of}
    same = [shown for shown, old in kept.items() if names[shown] == earlier.names[old]]
    gone = sorted(set(earlier.names) - set(kept.values()))
    into = {old: id_of[new] for old, new in found.merged.items() if new in id_of}
    parts = {id_of[new]: old for new, old in found.parts.items() if new in id_of}
    return {
        "format": FORMAT,
        "from": str(earlier.folder),
        "kept": [told(shown) for shown in sorted(same)],
        "renamed": [told(shown) | {"was": earlier.names[shown]} for shown in sorted(set(kept) - set(same))],
        "new": [told(i) | ({"part_of": parts[i]} if i in parts else {}) for i in sorted(set(names) - set(kept))],
        "gone": [
            {"id": old, "name": earlier.names[old]} | ({"merged_into": into[old]} if old in into else {})
            for old in gone
        ],
    }


def keep_names(
    earlier: EarlierLift, prepared: PreparedLift, lifted: StructuredScene, classes: ClassTable
) -> tuple[PreparedLift, LastingNames]:
    """The lift with the ids that last, in ``lifted`` too, and how its objects are called. Training does not know ids
    but by their places, so its result is the same bit for bit."""
    points = prepared.instance_of_point
    lasting = lasting_names(earlier, prepared.instances, prepared.cloud.xyz, points, classes)
    id_of = lasting.id_of
    table = np.zeros(max(id_of, default=0) + 1, np.int32)
    for one, shown in id_of.items():
        table[one] = shown
    channels = lifted.channels
    lifted.channels = replace(channels, slot_ids=tuple(id_of.get(slot, slot) for slot in channels.slot_ids))
    kinds = prepared.class_of_instance
    renamed = replace(
        prepared,
        instances=tuple(replace(one, id=id_of[one.id]) for one in prepared.instances),
        instance_of_point=table[points],
        class_of_instance=None if kinds is None else {id_of[one]: kind for one, kind in kinds.items()},
    )
    return renamed, lasting


def write_names(folder: LiftFolder, lasting: LastingNames, events: EventWriter) -> None:
    """result/names.json, and the counts as an event. Raises OSError."""
    write_atomically(folder.result_path / NAMES, json.dumps(lasting.changes, indent=1, ensure_ascii=False) + "\n")
    counts = {kind: len(lasting.changes[kind]) for kind in ("kept", "renamed", "new", "gone")}
    events.metric("names", counts)
    events.artifact(folder.result_path / NAMES, "names")
    log.info("names from %s: %s", lasting.changes["from"], counts)
    for kind in ("renamed", "new", "gone"):
        for one in lasting.changes[kind]:
            log.info("%s: %s", kind, ", ".join(f"{key} {value}" for key, value in one.items()))
    if not counts["kept"] and lasting.changes["gone"]:
        events.warning("no object is where one of the earlier lift was: was it lifted from the same scene?")


def _number(name: str, kind: str) -> int:
    """Of "chair 3" 3; 0 for a name of another form."""
    number = name.removeprefix(f"{kind} ")
    return int(number) if number != name and number.isdecimal() else 0
