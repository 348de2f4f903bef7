"""How much an artist who sees what is wrong mends with few corrections: edits that the truth suggests, scored.

The true label of each point is what most frames that are not held out show there. The held-out frames score. Whole
objects are corrected as a person would, the largest mistake first: another class, one object out of several, and back
into the stuff that it is of.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.corrections import CorrectedResult, Edit, correct, making, read_corrected
from engine.corrections.replay import Replay
from engine.errors import PlgsError
from engine.job import LiftFolder
from engine.job.report import read_metrics
from engine.lift.baking import score_corrected
from engine.scene import Scene, open_asked

MOST_EDITS = 19
SEEN_WITHIN = 0.05
"""Metres between a point and a frame's depth there within which the frame speaks of it."""
EVERY = 4
"""Every n-th frame speaks."""
LEAST_SHARE = 0.5
"""Share of an object's points that have one true label: below it a person would not say what the object is."""
MANY = 1 << 16
"""Factor of the class in a true label, which is class * this + instance."""

Make = Callable[[Replay, int], Edit]


@dataclass(frozen=True)
class Mistake:
    """What is wrong with how many points, and the edit that mends it."""

    points: int
    said: str
    make: Make


def true_labels(scene: Scene, xyz: NDArray[np.float32]) -> NDArray[np.int64]:
    """The true label of each point [N, 3] by most of the frames that see it, int64 [N], 0 where none does. Raises
    PlgsError for a scene without ground truth."""
    frames = [frame for frame in scene.train_frames if frame.read_ground_truth is not None][::EVERY]
    if not frames:
        raise PlgsError("has no ground truth", scene.folder, "Name a lift of a scene with ground truth.")
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


def mistakes(corrected: CorrectedResult, truth: NDArray[np.int64]) -> list[Mistake]:
    """What is wrong with whole objects, the most points first."""
    found, holders = [], dict[int, tuple[int, int]]()
    things = corrected.classes.thing_ids
    for one in sorted(corrected.instances, key=lambda each: -each.points):
        own = truth[corrected.points.instance_id == one.id]
        labels, counts = np.unique(own[own > 0], return_counts=True)
        if not len(labels) or counts.max() < LEAST_SHARE * len(own):
            continue
        label, count = int(labels[counts.argmax()]), int(counts.max())
        class_id = label // MANY
        if class_id in corrected.classes and class_id and class_id != one.class_id:
            said = f"{one.name} is {corrected.classes[class_id].name}"
            found.append(Mistake(count, said, _reclass(one.id, class_id)))
        if class_id in things and label in holders:
            kept = holders[label][0]
            found.append(Mistake(count, f"{one.name} is a part of object {kept}", _merge(kept, one.id)))
        elif class_id in things:
            holders[label] = one.id, count
    return sorted(found, key=lambda each: -each.points)


def _reclass(number: int, class_id: int) -> Make:
    return lambda state, _: making.reclass(state, [number], class_id)


def _merge(kept: int, other: int) -> Make:
    return lambda state, _: making.merge(state, [kept, other])


def correct_by_truth(lift: Path, most: int = MOST_EDITS) -> list[str]:
    """Make at most ``most`` edits of a finished lift. Returns what each says. Raises PlgsError, OSError."""
    folder = LiftFolder.open(lift)
    truth = true_labels(open_asked(folder.request), read_corrected(folder.path).points.xyz)
    said: list[str] = []
    while len(said) < most:
        left = mistakes(read_corrected(folder.path), truth)
        if not left:
            break
        correct(folder.path, left[0].make)
        said.append(left[0].said)
    return said


def before_and_after(lift: Path) -> tuple[float, float]:
    """Strict PQ of the lift as the engine made it, and as it is corrected, on the held-out frames."""
    folder = LiftFolder.open(lift)
    tables: list[Mapping[str, Any]] = [read_metrics(folder), score_corrected(folder, lambda _done, _steps: None)]
    before, after = (_strict_pq(metrics) for metrics in tables)
    return before, after


def _strict_pq(metrics: Mapping[str, Any]) -> float:
    found = [each for each in metrics["tables"] if each["name"] == "lifted" and each["mode"] == "strict"]
    return float(found[0]["pq"])
