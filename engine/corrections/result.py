"""A lift's result and what people corrected of it, read together: by Blender, bakes, exports and scores alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..result_files import (
    ANCHORS,
    INSTANCES,
    SEMANTIC_POINTS,
    Anchors,
    Instance,
    SemanticPoints,
    read_arrays,
    read_instances,
)
from ..scene import ClassTable
from .edits import CORRECTIONS, Edit
from .file import editing, read_edits
from .relabelling import Relabelling, labels_of
from .replay import Replay


@dataclass(frozen=True, eq=False)
class CorrectedResult:
    """The objects and points of a result after the edits.

    ``made`` are the objects as the engine made them. ``accepted`` are ids of objects that are right as they are.
    ``told``: why an edit was not applied, by its uid. ``fingerprint``: of the edits that change what is shown, empty
    where there is none.
    """

    folder: Path
    classes: ClassTable
    instances: tuple[Instance, ...]
    points: SemanticPoints
    made: tuple[Instance, ...]
    edits: tuple[Edit, ...]
    relabelling: Relabelling
    accepted: frozenset[int]
    told: dict[str, str]
    fingerprint: str

    @property
    def warnings(self) -> list[str]:
        """A line for each edit that was not applied."""
        return [
            f"{edit.kind} of {edit.time} is not applied: {self.told[edit.uid]}"
            for edit in self.edits
            if edit.uid in self.told
        ]

    @property
    def class_of(self) -> dict[int, int]:
        """The class of each object, by id."""
        return {one.id: one.class_id for one in self.instances}

    @property
    def changes_labels(self) -> bool:
        """Whether anything but names differs from what the engine made."""
        kinds = self.class_of
        return bool(self.relabelling.steps) or any(kinds.get(one.id) != one.class_id for one in self.made)

    def ids(
        self, xyz: NDArray[np.floating], class_id: NDArray[np.int32], instance_id: NDArray[np.int32]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The class and instance ids after the edits, int32 [N] each, of what stands at ``xyz`` [N, 3]."""
        before = labels_of(class_id, instance_id)
        return self.ids_of(before, self.relabelling.of(xyz, before), class_id)

    def ids_of(
        self, before: NDArray[np.int32], after: NDArray[np.int32], class_id: NDArray[np.int32]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """As ``ids``, from labels."""
        kinds, made = self.class_of, {one.id: one.class_id for one in self.made}
        changed = class_id.copy()
        moved = before != after
        changed[moved] = np.where(after[moved] > 0, 0, -after[moved])
        for number in np.unique(after[after > 0]).tolist():
            own = after == number
            if kinds.get(number) != made.get(number):
                changed[own] = kinds.get(number, 0)
            else:
                changed[own & moved] = kinds[number]
        return changed, np.maximum(after, 0).astype(np.int32)

    def anchors(self) -> Anchors:
        """Raises PlgsError."""
        anchors = read_arrays(self.folder / "result" / ANCHORS, Anchors)
        if not self.changes_labels:
            return anchors
        class_id, instance_id = self.ids(anchors.xyz, anchors.class_id, anchors.instance_id)
        return replace(anchors, class_id=class_id, instance_id=instance_id)


def read_corrected(lift: Path) -> CorrectedResult:
    """The result of the finished lift in this folder, with its corrections. Raises PlgsError when either cannot be
    read."""
    return _corrected(lift, read_edits(lift))[0]


def _corrected(lift: Path, edits: tuple[Edit, ...]) -> tuple[CorrectedResult, Replay]:
    result = lift / "result"
    classes, made = read_instances(result / INSTANCES)
    points = read_arrays(result / SEMANTIC_POINTS, SemanticPoints)
    state = Replay.of(classes, made, points)
    before = state.label.copy()
    state.apply_all(edits)
    instances = tuple(state.objects[number] for number in sorted(state.objects))
    shown = [edit.uid for edit in edits if not edit.undone and edit.kind != "accept" and edit.uid not in state.told]
    fingerprint = sha256("\n".join(shown).encode()).hexdigest()[:32] if shown else ""
    corrected = CorrectedResult(
        lift,
        classes,
        instances,
        points,
        made,
        edits,
        state.relabelling,
        frozenset(state.accepted),
        state.told,
        fingerprint,
    )
    if corrected.changes_labels:
        class_id, instance_id = corrected.ids_of(before, state.label, points.class_id)
        corrected = replace(corrected, points=replace(points, class_id=class_id, instance_id=instance_id))
    return corrected, state


Make = Callable[[Replay, int], Edit]
"""Makes an edit of the state, and of the first id that no object ever had."""


def correct(lift: Path, make: Make) -> Edit:
    """Add an edit to those of the lift in this folder, and return it. Raises PlgsError, OSError: then nothing is
    changed."""
    with editing(lift) as edits:
        corrected, state = _corrected(lift, tuple(edits))
        free = max([*(one.id for one in corrected.made), *(edit.largest_id for edit in edits)], default=0) + 1
        edit = make(state, free)
        reason = state.apply(edit)
        if reason:
            raise PlgsError(reason, lift / CORRECTIONS, "Choose what is there.")
        edits.append(edit)
        return edit


def undo(lift: Path) -> Edit:
    """Undo the last edit that is not undone, whoever made it. Raises PlgsError when there is none, OSError."""
    with editing(lift) as edits:
        for place in reversed(range(len(edits))):
            if not edits[place].undone:
                edits[place] = replace(edits[place], undone=True)
                return edits[place]
    raise PlgsError("there is no edit to undo", lift / CORRECTIONS, "")


def set_undone(lift: Path, undone: dict[str, bool]) -> None:
    """Undo edits, or do them again, by uid. Raises PlgsError, OSError."""
    with editing(lift) as edits:
        edits[:] = [replace(edit, undone=undone.get(edit.uid, edit.undone)) for edit in edits]
