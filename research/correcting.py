"""How much an artist who sees what is wrong can fix with few corrections: edits that the truth suggests, scored.

The true label of each point is the one that most training frames show there; held-out frames score the result. Objects
are corrected as a person would, the largest mistake first: give an object another class, merge several objects into
one, split one by the views, return it to its stuff, or paint points. The truth paints better than a hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.corrections import CorrectedResult, Edit, correct, making, read_corrected
from engine.corrections.replay import Replay
from engine.corrections.result import Make
from engine.errors import PlgsError
from engine.job import LiftFolder
from engine.job.report import read_metrics
from engine.lift.baking import score_corrected
from engine.lift.separating import parts_seen
from engine.result_files import Instance
from engine.scene import Scene, open_asked

MOST_EDITS = 19
SEEN_WITHIN = 0.05
"""Metres between a point and a frame's depth there within which the frame counts as seeing it."""
EVERY = 4
"""Every n-th frame counts."""
LEAST_SHARE = 0.5
"""Share of an object's points with one true label below which a person would not say what the object is."""
MIXED = 0.15
"""Share of an object's points from a second true thing above which a person sees that it is several."""
WORTH_PAINTING = 100
"""Least number of an object's unassigned points that somebody would paint."""
MANY = 1 << 16
"""A true label is class * MANY + instance."""


@dataclass(frozen=True)
class Mistake:
    """What is wrong, the number of points affected, and the edit that fixes it."""

    points: int
    description: str
    make: Make


def true_labels(scene: Scene, xyz: NDArray[np.float32]) -> NDArray[np.int64]:
    """The true label of each point [N, 3] by most of the frames that see it, int64 [N], 0 where no frame does. Raises
    PlgsError for a scene without ground truth."""
    frames = [frame for frame in scene.train_frames if frame.read_ground_truth is not None][::EVERY]
    if not frames:
        raise PlgsError("no-truth", "has no ground truth", scene.folder, "Name a lift of a scene with ground truth.")
    votes: dict[int, NDArray[np.int32]] = {}
    for frame in frames:
        assert frame.read_ground_truth is not None
        truth, depth = frame.read_ground_truth(frame.size), frame.depth(frame.size)
        label = truth.semantic.astype(np.int64) * MANY + truth.instance
        pixel, far = frame.camera.project(xyz)
        column, row = np.floor(pixel).astype(np.int64).T
        seen = (far > 0) & (column >= 0) & (column < depth.shape[1]) & (row >= 0) & (row < depth.shape[0])
        rows = np.flatnonzero(seen)
        rows = rows[np.abs(depth[row[rows], column[rows]] - far[rows]) < SEEN_WITHIN]
        shown = label[row[rows], column[rows]]
        for one in np.unique(shown).tolist():
            votes.setdefault(one, np.zeros(len(xyz), np.int32))[rows[shown == one]] += 1
    known = np.array(sorted(votes))
    table = np.stack([votes[one] for one in known.tolist()])
    return np.where(table.any(axis=0), known[table.argmax(axis=0)], 0)


def mistakes(folder: LiftFolder, corrected: CorrectedResult, truth: NDArray[np.int64]) -> list[Mistake]:
    """What is wrong with objects, the most points first: a wrong class, two objects that are one, one that is two and
    that the views separate, and unassigned points of an object, which somebody would paint."""
    found, holders = [], dict[int, Instance]()
    things, points = corrected.classes.thing_ids, corrected.points
    for one in sorted(corrected.instances, key=lambda each: -each.points):
        own = truth[points.instance_id == one.id]
        labels, counts = np.unique(own[own > 0], return_counts=True)
        if not len(labels):
            continue
        label, count = int(labels[counts.argmax()]), int(counts.max())
        others = [n for each, n in zip(labels.tolist(), counts.tolist(), strict=True) if each // MANY in things]
        rest = sum(others) - max(others, default=0)
        if rest >= MIXED * len(own):
            found.append(Mistake(rest, f"{one.name} is several things", _split(folder, one.id, truth)))
        if count < LEAST_SHARE * len(own):
            continue
        class_id = label // MANY
        if class_id in corrected.classes and class_id and class_id != one.class_id:
            description = f"{one.name} is {corrected.classes[class_id].name}"
            found.append(Mistake(count, description, _reclass(one.id, class_id)))
        if class_id in things and label in holders:
            whole = holders[label]
            found.append(Mistake(count, f"{one.name} is a part of {whole.name}", _merge(whole.id, one.id)))
        elif class_id in things:
            holders[label] = one
    for label, one in holders.items():
        astray = (truth == label) & (points.instance_id == 0)
        if astray.sum() >= WORTH_PAINTING:
            description = f"points of {one.name} are unassigned"
            found.append(Mistake(int(astray.sum()), description, _paint(one.id, astray)))
    return sorted(found, key=lambda each: -each.points)


def _split(folder: LiftFolder, number: int, truth: NDArray[np.int64]) -> Make:
    """A split by views. It is refused if the parts are no purer than the whole."""

    def make(state: Replay, first_id: int) -> Edit:
        seen = parts_seen(folder, state, number)
        edit, part = seen.split(state, number, first_id), seen.part
        own = truth[state.label == number]
        if sum(_most(own[part == each]) for each in np.unique(part)) < _most(own) + MIXED * len(own):
            raise PlgsError("not-purer", "the parts are not purer than the whole", folder.path, "Leave it whole.")
        return edit

    return make


def _most(labels: NDArray[np.int64]) -> int:
    """The number of points with the commonest true label."""
    known = labels[labels > 0]
    return int(np.unique(known, return_counts=True)[1].max(initial=0))


def _paint(number: int, chosen: NDArray[np.bool_]) -> Make:
    return lambda state, _: making.assign(state, chosen, number)


def _reclass(number: int, class_id: int) -> Make:
    return lambda state, _: making.reclass(state, [number], class_id)


def _merge(kept: int, other: int) -> Make:
    return lambda state, _: making.merge(state, [kept, other])


def correct_by_truth(lift: Path, most: int = MOST_EDITS) -> list[str]:
    """Make at most ``most`` edits of a finished lift, and return their descriptions. Raises PlgsError, OSError."""
    folder = LiftFolder.open(lift)
    corrected = read_corrected(folder.path)
    truth = true_labels(open_asked(folder.request), corrected.points.xyz)
    descriptions: list[str] = []
    left_alone = set[str]()
    while len(descriptions) < most:
        left = [each for each in mistakes(folder, corrected, truth) if each.description not in left_alone]
        if not left:
            break
        try:
            _, corrected = correct(folder.path, left[0].make)
        except PlgsError:  # what the views do not separate stays together
            left_alone.add(left[0].description)
        else:
            descriptions.append(left[0].description)
    return descriptions


def before_and_after(lift: Path) -> tuple[float, float]:
    """Strict PQ of the lift as the engine made it, and as corrected, on the held-out frames."""
    folder = LiftFolder.open(lift)
    corrected = score_corrected(folder, read_corrected(lift), lambda _done, _steps: None)
    made: list[Mapping[str, Any]] = [read_metrics(folder), corrected]
    before, after = (
        next(float(each["pq"]) for each in metrics["tables"] if each["name"] == "lifted" and each["mode"] == "strict")
        for metrics in made
    )
    return before, after
