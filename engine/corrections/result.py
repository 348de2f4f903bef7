"""Read a lift's result and people's corrections of it together: for Blender, bakes, exports and scores alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .. import result_files
from ..errors import PlgsError, did_you_mean
from ..posed import ClassTable
from ..posed.layout import listed as named
from ..posed.names import matte_names
from ..result_files import Anchors, Instance, Listed, SemanticPoints
from .edits import CORRECTIONS, Edit, editing, read_edits
from .fills import Fill, path_of, read_fill
from .relabelling import GONE, Relabelling, labels_of
from .replay import Replay


@dataclass(frozen=True, eq=False)
class CorrectedResult:
    """The objects (``instances``) and points of a result after the ``edits``; ``relabelling`` changes the labels of
    anything else. ``made`` are the objects as the engine made them, ``removed`` those that were taken out of the room.
    ``accepted`` are ids of objects that a person confirmed. ``not_applied`` gives, by the uid of an edit, why it was
    not applied. ``fingerprint`` identifies the edits that change what is shown; it is "" without any."""

    folder: Path
    classes: ClassTable
    instances: tuple[Instance, ...]
    points: SemanticPoints
    made: tuple[Instance, ...]
    removed: tuple[Instance, ...]
    edits: tuple[Edit, ...]
    relabelling: Relabelling
    accepted: frozenset[int]
    not_applied: dict[str, str]
    fingerprint: str

    @property
    def names_in_mattes(self) -> dict[int, str]:
        """The objects' names as Cryptomatte has them, unique, by id."""
        return matte_names({one.id: one.name for one in self.instances})

    @property
    def left_unowned(self) -> frozenset[int]:
        """The ids of classes that edits gave to points without an object, as a delete does."""
        applied = [edit for edit in self.edits if edit.uid not in self.not_applied]
        rests = [edit.rest or 0 for edit in applied if edit.kind == "delete" and not edit.moved]
        return frozenset(-each for each in (*rests, *(one.label for edit in applied for one in edit.moved)) if each < 0)

    @property
    def warnings(self) -> list[str]:
        """A line for each edit that was not applied."""
        return [
            f"{edit.kind} of {edit.time} was not applied: {self.not_applied[edit.uid]}"
            for edit in self.edits
            if edit.uid in self.not_applied
        ]

    @property
    def label_fingerprint(self) -> str:
        """A text that identifies the edits that change more than names; "" without any."""
        return _fingerprint(self.edits, self.not_applied, ("accept", "rename"))

    @property
    def class_of(self) -> dict[int, int]:
        return {one.id: one.class_id for one in self.instances}

    @property
    def changes_labels(self) -> bool:
        """Whether the edits change more than names."""
        kinds = self.class_of
        return bool(self.relabelling.steps) or any(kinds.get(one.id) != one.class_id for one in self.made)

    def ids(
        self, xyz: NDArray[np.floating], class_id: NDArray[np.int32], instance_id: NDArray[np.int32]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Class and instance ids after the edits, int32 [N] each, of points at ``xyz`` [N, 3] that had these ids."""
        before = labels_of(class_id, instance_id)
        return self.ids_of(before, self.relabelling.of(xyz, before), class_id)

    def ids_of(
        self, before: NDArray[np.int32], after: NDArray[np.int32], class_id: NDArray[np.int32]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return class and instance ids after the edits, int32 [N] each, of points with the labels ``before`` and
        ``after`` the edits, [N] each, and the classes ``class_id`` [N] before."""
        kinds, made = self.class_of, {one.id: one.class_id for one in self.made}
        changed = class_id.copy()
        moved = before != after
        changed[moved] = np.where(after[moved] > 0, 0, -after[moved])
        for number in np.unique(after[after > 0]).tolist():
            own = after == number
            if kinds.get(number) != made.get(number):
                changed[own] = kinds.get(number, 0)
            else:
                changed[own & (moved | (class_id == 0))] = kinds[number]  # fills know only their object
        return changed, np.maximum(after, 0).astype(np.int32)

    def anchors(self) -> Anchors:
        """Return the anchors after the edits, without those of removed objects. Raises PlgsError for a damaged file."""
        anchors = result_files.read_arrays(self.folder / "result" / result_files.ANCHORS, Anchors)
        if not self.changes_labels:
            return anchors
        before = labels_of(anchors.class_id, anchors.instance_id)
        after = self.relabelling.of(anchors.xyz, before)
        class_id, instance_id = self.ids_of(before, after, anchors.class_id)
        relabelled = replace(anchors, class_id=class_id, instance_id=instance_id)
        return Anchors(**{name: values[after != GONE] for name, values in vars(relabelled).items()})

    def splats(self, rows: NDArray[np.void]) -> NDArray[np.void]:
        """Return the rows [N] of gaussians.ply with their labels after the edits, without the Gaussians of removed
        objects, and with the Gaussians that replace these."""
        if not self.changes_labels:
            return rows
        parts = list[NDArray[np.void]]()
        for first, fill in [(0, None), *self.relabelling.fills]:
            part = rows.copy() if fill is None else fill.splats(rows.dtype)
            before = labels_of(part["class_id"], part["instance_id"])
            after = self.relabelling.of(np.stack([part[axis] for axis in "xyz"], axis=1), before, first)
            part["class_id"], part["instance_id"] = self.ids_of(before, after, part["class_id"].astype(np.int32))
            parts.append(part[after != GONE])
        return np.concatenate(parts)


def read_corrected(lift: Path, listed: Listed | None = None, further: Sequence[Edit] = ()) -> CorrectedResult:
    """Read the result of the finished lift in this folder with its corrections, and with ``further`` edits that are not
    saved. ``listed`` is the content of instances.json, if already read. Raises PlgsError for a damaged file."""
    return MadeResult.read(lift, listed).corrected([*read_edits(lift), *further])


def _fingerprint(edits: Sequence[Edit], not_applied: Mapping[str, str], without: tuple[str, ...]) -> str:
    """Return a text that identifies the applied edits, except those of the kinds ``without``; "" if there are none."""
    uids = [each.uid for each in edits if not each.undone and each.kind not in without and each.uid not in not_applied]
    return sha256("\n".join(uids).encode()).hexdigest()[:32] if uids else ""


def replayed(lift: Path) -> Replay:
    """Return the objects and points of a finished lift after its corrections. Raises PlgsError for a damaged file."""
    return MadeResult.read(lift).replay(read_edits(lift))


@dataclass(frozen=True, eq=False)
class MadeResult:
    """The objects and points of a ``lift``'s result, in the folder ``path``, as the engine made it, before corrections.
    """

    lift: Path
    path: Path
    classes: ClassTable
    made: tuple[Instance, ...]
    points: SemanticPoints

    @classmethod
    def read(cls, lift: Path, listed: Listed | None = None, name: str = "result") -> MadeResult:
        """Read a lift's result, in its folder ``name``; ``listed`` is its instances.json, if read. Raises PlgsError if
        damaged."""
        path = lift / name
        classes, made = listed or result_files.read_instances(path / result_files.INSTANCES)
        points = result_files.read_arrays(path / result_files.SEMANTIC_POINTS, SemanticPoints)
        return cls(lift, path, classes, made, points)

    def fill_of(self, edit: Edit) -> Fill:
        """Read the fill of a removal: the result's own, if a later lift made one, else the edit's. Raises PlgsError if
        it is missing or damaged."""
        own = path_of(self.path, edit.fill)
        return read_fill(own) if own.is_file() else read_fill(path_of(self.lift, edit.fill), edit.digest)

    def replay(self, edits: Sequence[Edit]) -> Replay:
        state = Replay.of(self.classes, self.made, self.points, self.fill_of)
        state.apply_all(edits)
        return state

    def corrected(self, edits: Sequence[Edit], state: Replay | None = None) -> CorrectedResult:
        """Return the result after the edits. ``state`` is the outcome of applying them, if that was done already."""
        state = state or self.replay(edits)
        fingerprint = _fingerprint(edits, state.not_applied, ("accept",))
        corrected = CorrectedResult(
            self.lift, self.classes, tuple(state.objects[number] for number in sorted(state.objects)), state.points,
            self.made, tuple(state.removed[number] for number in sorted(state.removed)), tuple(edits),
            state.relabelling, frozenset(state.accepted), state.not_applied, fingerprint,
        )  # fmt: skip
        if not corrected.changes_labels:
            return corrected
        before = labels_of(state.points.class_id, state.points.instance_id)
        class_id, instance_id = corrected.ids_of(before, state.label, state.points.class_id)
        return replace(corrected, points=replace(state.points, class_id=class_id, instance_id=instance_id))


Make = Callable[[Replay, int], Edit]
"""Makes an edit from the state and the first unused object id."""


def correct(lift: Path, make: Make, listed: Listed | None = None) -> tuple[Edit, CorrectedResult]:
    """Add the edit that ``make`` returns to those of the lift in this folder. Returns the edit and the new result.
    ``listed`` is the content of instances.json, if read. Raises PlgsError, OSError; nothing is then changed."""
    with editing(lift) as edits:
        result = MadeResult.read(lift, listed)
        state = result.replay(edits)
        # above those of undone edits, too, which can be redone
        free = max([*(one.id for one in result.made), *(edit.largest_id for edit in edits)], default=0) + 1
        edit = make(state, free)
        reason = state.apply(edit)
        if reason:
            raise PlgsError("edit-impossible", reason, lift, "Choose objects and classes that exist.")
        edits.append(edit)
    return edit, result.corrected(edits, state)


def undo(lift: Path, listed: Listed | None = None) -> tuple[Edit, CorrectedResult]:
    """Undo the last edit that is not undone, whoever made it (``listed``: instances.json, if read). Returns the edit
    and the result without it. Raises PlgsError if there is none, and OSError."""
    with editing(lift) as edits:
        last = max((index for index, edit in enumerate(edits) if not edit.undone), default=-1)
        if last < 0:
            raise PlgsError("nothing-to-undo", "there is no edit to undo", lift / CORRECTIONS, "")
        edits[last] = replace(edits[last], undone=True)
    return edits[last], MadeResult.read(lift, listed).corrected(edits)


def put_back(lift: Path, objects: Sequence[int | str], listed: Listed | None = None) -> tuple[Edit, CorrectedResult]:
    """Undo the removals of ``objects``, ids or names. Returns the last of these edits and the result without them.
    Raises PlgsError if one of the objects is not removed, and OSError; nothing is then changed."""
    with editing(lift) as edits:
        result = MadeResult.read(lift, listed)
        state, ids = result.replay(edits), set[int]()
        # Also those that are still shown, as their fill is lost.
        lost = {mark.id for edit in edits if edit.kind == "remove" and edit.uid in state.not_applied
                for mark in edit.objects}  # fmt: skip
        names = {number: state.objects[number].name if number in state.objects else "" for number in lost}
        names |= {number: one.name for number, one in state.removed.items()}
        for said in objects:
            found = [number for number, name in names.items() if str(said) in (str(number), name or None)]
            if not found:
                hint = did_you_mean(str(said), names.values())
                fix = f"{hint}Removed: {named(names.values(), 40) or 'nothing'}."
                raise PlgsError("not-removed", f"object {said} is not removed", lift, fix)
            ids |= {*found}
        for row, edit in enumerate(edits):
            if edit.kind == "remove" and not edit.undone and ids.intersection(mark.id for mark in edit.objects):
                edits[row] = last = replace(edit, undone=True)
    return last, result.corrected(edits)


def set_undone(lift: Path, undone: dict[str, bool]) -> None:
    """Undo or redo edits: ``undone`` maps their uids to True or False. Raises PlgsError for a bad file, OSError."""
    with editing(lift) as edits:
        edits[:] = [replace(edit, undone=undone.get(edit.uid, edit.undone)) for edit in edits]
