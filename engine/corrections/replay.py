"""Apply edits to the objects and points of a result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..posed import ClassTable, distinct_colour
from ..result_files import Instance, SemanticPoints
from .edits import CORRECTIONS, KINDS, MOVES, PER_METRE, Edit, MovedPoints, ObjectMark
from .fills import NOTHING, Fill, cell_keys
from .relabelling import GONE, Labels, Relabelling, Step, labels_of, nearest, step_of

LEAST_OVERLAP = 0.2
"""Least intersection over union of the boxes at which an object is the one that an edit means."""
PADDING = 0.05
"""Metres added around these boxes: pictures on a wall have no thickness, and lifts differ by some centimetres."""
REACH = 0.04
"""Metres within which a point of another lift follows a point that was moved."""
MOST_LOST = 0.1
"""Share of an edit's points that may be missing if the lift is still the same one."""
INNER = (2.0, 98.0)
"""Percentiles of the points that span a mark's box, as single points stray."""
OUTER = (0.5, 99.5)
"""Percentiles of the points that span an object's new box."""


@dataclass(eq=False)
class Replay:
    """The objects and points after some edits. ``label`` int32 [N] is the label of each of the ``points``.
    ``not_applied`` gives, by the uid of an edit, why it could not be applied. ``removed`` are objects taken out of the
    room, ``accepted`` ids that a person confirmed, ``renamed`` those that a person named. ``owners``: every name that
    an object has or had, and its id. ``fill_of`` reads a removal's fill; it may raise PlgsError."""

    classes: ClassTable
    points: SemanticPoints
    label: Labels
    objects: dict[int, Instance]
    fill_of: Callable[[Edit], Fill] = lambda edit: NOTHING
    removed: dict[int, Instance] = field(default_factory=dict)
    accepted: set[int] = field(default_factory=set)
    renamed: set[int] = field(default_factory=set)
    owners: dict[str, int] = field(default_factory=dict)
    steps: list[Step] = field(default_factory=list)
    not_applied: dict[str, str] = field(default_factory=dict)
    _marks: dict[int, ObjectMark] = field(default_factory=dict)
    """The marks of objects as the points are labelled now: making one takes a look at all points."""

    @classmethod
    def of(
        cls, classes: ClassTable, instances: Iterable[Instance], points: SemanticPoints,
        fill_of: Callable[[Edit], Fill] = lambda edit: NOTHING,
    ) -> Replay:  # fmt: skip
        """Return the state before any edit: a result as it was made. ``fill_of`` reads a removal's fill."""
        label = labels_of(points.class_id, points.instance_id)
        objects = {one.id: one for one in instances}
        return cls(classes, points, label, objects, fill_of, owners={one.name: one.id for one in objects.values()})

    @property
    def xyz(self) -> NDArray[np.float32]:
        """The points' positions, [N, 3] metres."""
        return self.points.xyz

    def apply_all(self, edits: Iterable[Edit]) -> None:
        for edit in edits:
            if not edit.undone:
                reason = self.apply(edit)
                if reason:
                    self.not_applied[edit.uid] = reason

    @property
    def relabelling(self) -> Relabelling:
        return Relabelling(tuple(self.steps))

    def class_of(self, label: int) -> int:
        """Return the class of a label: its object's, or its own if it is stuff."""
        return self.objects[label].class_id if label > 0 and label in self.objects else max(-label, 0)

    def points_of(self, number: int) -> NDArray[np.float32]:
        return self.xyz[self.label == number]

    def mark(self, number: int) -> ObjectMark:
        """Return the mark by which an object is recognised later, from its points."""
        points = self.points_of(number)
        low, high = np.percentile(points, INNER, axis=0) if len(points) else np.zeros((2, 3))
        corners = (tuple(round(float(value), 3) for value in corner) for corner in (low, high))
        return ObjectMark(number, len(points), *corners)  # type: ignore[arg-type]

    def apply(self, edit: Edit) -> str:
        """Apply an edit. Returns "", or why it cannot be applied and changes nothing."""
        if edit.kind not in KINDS:
            return f"this version does not know the edit {edit.kind!r}"
        reasons = [reason for mark in edit.objects if (reason := self.missing(mark))]
        if reasons and (edit.kind != "assign" or len(reasons) == len(edit.objects)):
            return reasons[0]
        ids = [*dict.fromkeys(mark.id for mark in edit.objects if mark.id in self.objects)]
        if not ids and (edit.kind != "assign" or not edit.classes):
            return "it names no object"
        if edit.kind == "merge" and len(ids) < 2:
            return "it names only one object"
        if edit.kind in MOVES and (reason := self._no_label(edit)):
            return reason
        if edit.kind in (*MOVES, "merge", "remove"):
            self._marks.clear()  # such an edit changes the labels of points
        match edit.kind:
            case "rename":
                self._call(ids[0], edit.name)
                self.renamed.add(ids[0])
            case "reclass":
                return self._reclass(edit, ids)
            case "merge":
                self._merge(ids)
            case "accept":
                self.accepted.update(ids)
            case "remove":
                return self._remove(edit, ids)
            case kind if kind in MOVES:
                return self._move(edit, ids)
        return ""

    def _no_label(self, edit: Edit) -> str:
        """Return why an edit would give points a label that does not exist as an object or class, or ""."""
        rest = 0 if edit.rest is None else edit.rest
        classes = [-label for label in (rest, *(group.label for group in edit.moved)) if label < 0]
        classes += [edit.class_id] if edit.class_id else []
        unknown = [one for one in (*classes, *(one.class_id for one in edit.made)) if one not in self.classes]
        if unknown:
            return f"there is no class {unknown[0]}"
        return f"there is no object {rest}" if rest > 0 and rest not in self.objects else ""

    def missing(self, mark: ObjectMark) -> str:
        """Return why the object that a mark refers to is missing, or ""."""
        if mark.id not in self.objects:
            return f"there is no object {mark.id}"
        now = self._marks.get(mark.id) or self._marks.setdefault(mark.id, self.mark(mark.id))
        boxes = (np.array([each.low, each.high]) + [[-PADDING], [PADDING]] for each in (mark, now))
        if mark != now and mark.points and now.points and overlap(*boxes) < LEAST_OVERLAP:
            return f"object {mark.id} ({self.objects[mark.id].name}) is a different object in this lift"
        return ""

    def _call(self, number: int, name: str) -> None:
        self.objects[number] = replace(self.objects[number], name=name)
        self.owners[name] = number

    def _reclass(self, edit: Edit, ids: Sequence[int]) -> str:
        if edit.class_id not in self.classes:
            return f"there is no class {edit.class_id}"
        names = dict(zip((mark.id for mark in edit.objects), edit.names, strict=False))
        for number in ids:
            kind = self.classes[edit.class_id].name
            self.objects[number] = replace(self.objects[number], class_id=edit.class_id, class_name=kind)
            self._call(number, names.get(number) or self.objects[number].name)
        return ""

    def _merge(self, ids: Sequence[int]) -> None:
        kept, others = ids[0], [self.objects.pop(number) for number in ids[1:]]
        one = self.objects[kept]
        every = (one, *others)
        frames = {segment.frame for each in every for segment in each.segments}
        score = sum(each.score * max(each.points, 1) for each in every) / sum(max(each.points, 1) for each in every)
        segments = tuple(segment for each in every for segment in each.segments)
        views = len(frames) or max(each.views for each in every)
        self.objects[kept] = replace(one, views=views, score=score, segments=segments)
        step = Step({each.id: kept for each in others})
        step.apply(self.xyz, self.label)
        self.steps.append(step)
        self._fit([kept])

    def _remove(self, edit: Edit, ids: Sequence[int]) -> str:
        try:
            fill = self.fill_of(edit)
            if {*fill.label.tolist()} - {0, *self.objects, *(-one.id for one in self.classes.categories)}:
                raise PlgsError("fill-of-others", "what is in its place has an unknown label", CORRECTIONS, "")
        except PlgsError as error:
            names = ", ".join(self.objects[each].name for each in ids)
            return f"{error.what} ({error.where}): put {names} back and remove {'them' if ids[1:] else 'it'} again"
        step = Step(dict.fromkeys(ids, GONE), fill=fill)
        step.apply(self.xyz, self.label)
        self.steps.append(step)
        stays, (points, label) = self.label != GONE, fill.points()
        both = ((name, [each[stays], getattr(points, name)]) for name, each in vars(self.points).items())
        self.points = SemanticPoints(**{name: np.concatenate(each) for name, each in both})
        self.label = np.concatenate([self.label[stays], label])
        self.removed.update((number, self.objects.pop(number)) for number in ids)
        return ""

    def _move(self, edit: Edit, ids: Sequence[int]) -> str:
        known = {one.id for one in edit.made} | self.objects.keys()
        groups = [group for group in edit.moved if group.label <= 0 or group.label in known]
        lost = [group.label for group in edit.moved if group not in groups]
        if lost and not groups:
            return f"there is no object {lost[0]}"
        sources = np.array([*ids, *(-one for one in edit.classes)], np.int64)
        rows = np.flatnonzero(np.isin(self.label, sources))
        before = self.label[rows]
        after = before.copy()
        if edit.rest is not None:
            after[np.isin(before, ids)] = edit.rest
        _take_moved(self.xyz[rows], after, groups)
        if edit.kind != "delete" and (after == before).all():
            return "none of its points are in this lift"
        base = self.objects[ids[0]] if ids else None
        self.steps.append(step_of(self.xyz[rows], before, after))
        self.label[rows] = after
        for made in edit.made:
            if (after == made.id).any():
                self.objects[made.id] = self._made(made.id, made.name, made.class_id, base)
                self.owners[made.name] = made.id
        for number in ids:
            if (before == number).any():
                if not (after == number).any():
                    del self.objects[number]
            elif edit.rest is not None:  # it had no point, but perhaps a Gaussian
                del self.objects[number]
                self.steps.append(Step({number: edit.rest}))
        self._fit([number for number in {*ids, *np.unique(after).tolist()} if number in self.objects])
        if edit.class_id:
            self._reclass(edit, [number for number in ids if number in self.objects])
        return ""

    def _made(self, number: int, name: str, class_id: int, base: Instance | None) -> Instance:
        """A new object, made of some points, with the evidence and the axes of ``base``, to which they belonged."""
        yaw, rotation = (base.yaw, base.rotation) if base else (0.0, (1.0, 0.0, 0.0, 0.0))
        views, score, segments = (base.views, base.score, base.segments) if base else (0, 0.0, ())
        colour, kind = distinct_colour(number), self.classes[class_id].name
        none = (0.0, 0.0, 0.0)
        return Instance(number, name, class_id, kind, colour, none, none, yaw, rotation, views, score, 0, segments)

    def _fit(self, ids: Iterable[int]) -> None:
        """Fit the boxes of the objects ``ids`` to their points; each box keeps the directions of its axes."""
        for number in ids:
            points, one = self.points_of(number), self.objects[number]
            if len(points):
                axes = _matrix(one.rotation)
                low, high = np.percentile(points.astype(np.float64) @ axes, OUTER, axis=0)
                x, y, z = (axes @ ((low + high) / 2)).tolist()
                length, width, height = np.maximum(high - low, 0.01).tolist()
                box = replace(one, centre=(x, y, z), size=(length, width, height))
                self.objects[number] = replace(box, points=len(points))
            else:
                self.objects[number] = replace(one, points=0)


def _take_moved(xyz: NDArray[np.float32], after: Labels, groups: Sequence[MovedPoints]) -> None:
    """Write the labels that ``groups`` give points among ``xyz`` [N, 3] into ``after`` [N]. In another lift, which has
    other points, those near the points of ``groups`` get their labels."""
    if not groups or not len(xyz):
        return
    wanted = np.concatenate([np.array(group.millimetres, np.int64).reshape(-1, 3) for group in groups])
    target = np.concatenate([np.full(len(group.millimetres) // 3, group.label, np.int32) for group in groups])
    if not len(wanted):
        return
    keys, own = cell_keys(wanted), cell_keys(in_millimetres(xyz))
    order = np.argsort(keys, kind="stable")
    index = order[np.minimum(np.searchsorted(keys, own, sorter=order), len(keys) - 1)]
    found = keys[index] == own
    if np.isin(keys, own).mean() >= 1.0 - MOST_LOST:
        after[found] = target[index[found]]
        return
    index, distance = nearest(xyz, wanted / PER_METRE)
    after[distance <= REACH] = target[index[distance <= REACH]]


def in_millimetres(xyz: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return points [N, 3] in metres as whole millimetres, int64 [N, 3], which is how edits keep them."""
    return np.rint(xyz.astype(np.float64) * PER_METRE).astype(np.int64)


def overlap(one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    """Return the intersection over union of two boxes, each by its lowest and its highest corner, [2, D]."""
    common = np.prod(np.maximum(np.minimum(one[1], other[1]) - np.maximum(one[0], other[0]), 0.0))
    return float(common / max(np.prod(one[1] - one[0]) + np.prod(other[1] - other[0]) - common, 1e-9))


def _matrix(rotation: tuple[float, float, float, float]) -> NDArray[np.float64]:
    w, x, y, z = np.array(rotation) / max(float(np.linalg.norm(rotation)), 1e-9)
    across = 2 * np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])  # Rodrigues' formula in terms of the quaternion
    return np.asarray(np.eye(3) + w * across + across @ across / 2)
