"""Change labels by edits, for anything with a position: a point, an anchor, a Gaussian. An edit of whole objects maps
labels to labels. An edit of points names only the points; everything else follows the nearest point that had the same
label before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .fills import Fill

_PAIRS = 1 << 22
"""The largest number of distances held at a time."""
_MANY = 1 << 27
"""Number of pairs above which a k-d tree, if available, is faster despite its import."""


def nearest(
    queries: NDArray[np.floating], points: NDArray[np.floating]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the nearest of ``points`` [N, 3] (at least one) to each of ``queries`` [Q, 3]. Returns its index, int64 [Q],
    and its distance, float64 [Q]."""
    if len(queries) * len(points) > _MANY:
        try:
            from scipy.spatial import cKDTree
        except ImportError:
            pass
        else:
            far, index = cKDTree(points).query(queries)
            return np.asarray(index, np.int64), np.asarray(far, np.float64)
    middle = points.mean(axis=0, dtype=np.float64)  # near the origin, squared distances cancel less
    near = (points - middle).astype(np.float64)
    squared = (near * near).sum(axis=1)
    found, least = np.empty(len(queries), np.int64), np.empty(len(queries), np.float64)
    step = max(1, _PAIRS // len(points))
    for start in range(0, len(queries), step):
        some = (queries[start : start + step] - middle).astype(np.float64)
        distance = squared - 2.0 * (some @ near.T)  # without the queries' own squares, which do not change the order
        rows = distance.argmin(axis=1)
        found[start : start + step] = rows
        least[start : start + step] = distance[np.arange(len(some)), rows] + (some * some).sum(axis=1)
    return found, np.sqrt(np.maximum(least, 0.0))  # rounding may leave a square below 0


Labels = NDArray[np.int32]
GONE = -(10**9)
"""The label of what was removed."""


def labels_of(class_id: NDArray[np.integer], instance_id: NDArray[np.integer]) -> Labels:
    """Return the labels for class and instance ids [N]: the instance or, without one, minus the class; int32 [N]."""
    return np.where(instance_id > 0, instance_id, -class_id.astype(np.int64)).astype(np.int32)


@dataclass(frozen=True, eq=False)
class Step:
    """One change of labels. ``table`` maps labels that change as a whole. ``points`` holds, by old label, the points
    that had it, float32 [N, 3], and their new labels, int32 [N]. ``fill`` belongs to a removal: what it replaces in
    its cells is removed, too."""

    table: Mapping[int, int] = field(default_factory=dict)
    points: Mapping[int, tuple[NDArray[np.float32], Labels]] = field(default_factory=dict)
    fill: Fill | None = None

    def apply(self, xyz: NDArray[np.floating], label: Labels) -> None:
        """Apply the step to the ``label`` [N] of points at ``xyz`` [N, 3], in place; GONE marks what it removes."""
        rows_of = {source: np.flatnonzero(label == source) for source in (*self.table, *self.points)}  # before changes
        for source, target in self.table.items():
            label[rows_of[source]] = target
        for source, (points, after) in self.points.items():
            rows = rows_of[source]
            if len(rows):
                label[rows] = after[nearest(xyz[rows], points)[0]]
        if self.fill is not None:
            label[self.fill.clears(xyz, label)] = GONE


def step_of(xyz: NDArray[np.float32], before: Labels, after: Labels) -> Step:
    """The step that changes points ``xyz`` [N, 3] with the labels ``before`` to the labels ``after``, [N] each."""
    table, points = {}, {}
    for source in np.unique(before[before != after]).tolist():
        rows = before == source
        targets = np.unique(after[rows])
        if len(targets) == 1:
            table[source] = int(targets[0])
        else:
            points[source] = xyz[rows], after[rows]
    return Step(table, points)


@dataclass(frozen=True, eq=False)
class Relabelling:
    """The changes of labels that all edits make: ``steps``, in order."""

    steps: tuple[Step, ...] = ()

    @property
    def sources(self) -> frozenset[int]:
        """The labels that at least one step changes."""
        return frozenset(source for step in self.steps for source in (*step.table, *step.points))

    @property
    def fills(self) -> list[tuple[int, Fill]]:
        """The fills of removals, each with the number of the steps up to its removal; it is added after these steps."""
        return [(number, step.fill) for number, step in enumerate(self.steps, start=1) if step.fill is not None]

    def of(self, xyz: NDArray[np.floating], label: Labels, first: int = 0) -> Labels:
        """Return the labels, int32 [N], of points at ``xyz`` [N, 3] with the labels ``label`` [N] after all steps from
        ``first`` on; GONE for what was removed."""
        after = label.copy()
        changes = np.isin(label, sorted(self.sources))
        for _, fill in self.fills:
            changes |= fill.clears(xyz, label)
        rows = np.flatnonzero(changes)
        some, changed = xyz[rows], after[rows]
        for step in self.steps[first:]:
            step.apply(some, changed)
        after[rows] = changed
        return after
