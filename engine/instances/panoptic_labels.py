"""One label for class and object together, and the rule by which a point, a pixel and a Gaussian decide what they show:
class first, then the object of that class.

A thing that belongs to an object has the object's label, which implies the object's class. Stuff, and things that no
object owns, have only a class: "no object" is a label like any other. Everything has some coverage of every class,
including the coverage of the class's objects. The largest class wins. Its largest object is shown if it has enough of
the class; otherwise the class is shown alone. So an object is never shown with a class other than its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..machine.compiled import Array, compiled, device_function

LEAST_OF_CLASS = 0.1
"""Minimum fraction of its class's coverage for an object to be shown."""


@device_function
def object_of_class(shown: Array, columns: Array, class_of_object: Array, wanted: int, least: float) -> int:
    """The object 0..U-1 of class ``wanted`` with the largest coverage (the first if several tie); -1 if none has
    more than ``least``. ``shown`` [W] holds at ``columns`` int64 [U] the coverage of each object,
    ``class_of_object`` [U] its class."""
    best, most = -1, least
    for number in range(len(columns)):
        if class_of_object[number] == wanted and shown[columns[number]] > most:
            best, most = number, shown[columns[number]]
    return best


def objects_of_classes(
    shown: NDArray[np.floating],
    columns: NDArray[np.int64],
    class_of_object: NDArray[np.integer],
    wanted: NDArray[np.integer],
    least: NDArray[np.floating],
) -> NDArray[np.int64]:
    """``object_of_class`` for each row of ``shown`` [N, W], int64 [N]; ``wanted`` and ``least`` are [N]."""
    found = np.empty(len(shown), np.int64)
    classes, rows = class_of_object.astype(np.int64), np.ascontiguousarray(shown)
    _fill_objects(rows, columns, classes, wanted.astype(np.int64), least, found)
    return found


@compiled
def _fill_objects(
    shown: Array, columns: Array, class_of_object: Array, wanted: Array, least: Array, found: Array
) -> None:
    """The loop behind ``objects_of_classes``."""
    for row in range(len(shown)):
        found[row] = object_of_class(shown[row], columns, class_of_object, wanted[row], least[row])


@dataclass(frozen=True)
class ClassBalance:
    """How much a vote for each class counts, ``weights`` [C], unless one class has at least the share ``majority`` of
    the votes. By default all votes count alike."""

    weights: tuple[float, ...] = ()
    majority: float = 0.0

    def of(self, votes: NDArray[np.floating]) -> NDArray[np.floating]:
        """The balanced ``votes`` [N, C]."""
        if not self.weights:
            return votes
        is_clear = votes.max(1, initial=0) >= self.majority * votes.sum(1)
        weighted = votes * np.asarray(self.weights, votes.dtype)
        return np.where(is_clear[:, None], votes, weighted)


UNBALANCED = ClassBalance()

UNKNOWN_LABEL = -1
"""Label of a pixel or point that has no label."""


@dataclass(frozen=True)
class PanopticLabels:
    """Labels 0..C-1 are the classes ``class_ids`` without an object. Labels C..C+U-1 are the objects 1..U in order,
    with the classes ``class_of_object`` (length U, each in ``class_ids``). Votes on them are in ``balance``."""

    class_ids: tuple[int, ...]
    class_of_object: tuple[int, ...]
    balance: ClassBalance = UNBALANCED

    def __len__(self) -> int:
        return len(self.class_ids) + len(self.class_of_object)

    @property
    def class_column(self) -> NDArray[np.int64]:
        """The index of each label's class in ``class_ids``, int64 [C + U]."""
        objects = np.searchsorted(self.class_ids, self.class_of_object)
        return np.concatenate([np.arange(len(self.class_ids)), objects]).astype(np.int64)

    def of_class(self, class_id: int) -> int:
        """The label of a class without an object; ``UNKNOWN_LABEL`` for a class that is not in ``class_ids``."""
        return self.class_ids.index(class_id) if class_id in self.class_ids else UNKNOWN_LABEL

    def of_object(self, number: int) -> int:
        """The label of object 1..U."""
        return len(self.class_ids) + number - 1

    def of_points(self, class_id: NDArray[np.int32], number: NDArray[np.int32]) -> NDArray[np.int32]:
        """The labels of points with a class int32 [N] (0 = unknown) and an object int32 [N] (0 = none)."""
        column = np.minimum(np.searchsorted(self.class_ids, class_id), len(self.class_ids) - 1)
        of_class = np.where(np.asarray(self.class_ids)[column] == class_id, column, UNKNOWN_LABEL)
        return np.where(number > 0, number + len(self.class_ids) - 1, of_class).astype(np.int32)

    def classes(self, labels: NDArray[np.integer]) -> NDArray[np.int32]:
        """The class id of each label [...], int32, 0 for unknown."""
        table = np.append(np.asarray(self.class_ids, np.int32)[self.class_column], 0).astype(np.int32)  # last: for -1
        return table[labels]

    def objects(self, labels: NDArray[np.integer]) -> NDArray[np.int32]:
        """The object number of each label [...], int32, 0 for none and for unknown."""
        found = np.asarray(labels, np.int32) - (len(self.class_ids) - 1)
        return np.maximum(found, 0)


def decide_labels(
    votes: NDArray[np.floating], labels: PanopticLabels, least_share: float
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The label of each row of votes [N, C + U], int32 [N], and the winning class's share of the votes, float32 [N], by
    the rule above. Votes for an object also count for its class, and an object needs ``least_share`` of its class's
    votes. Ties go to the lower label; rows without votes are unknown."""
    classes, column = len(labels.class_ids), labels.class_column
    by_class = np.array(votes[:, :classes], np.float32)
    for number in range(classes, len(labels)):
        by_class[:, column[number]] += votes[:, number]
    winner = labels.balance.of(by_class).argmax(1)
    most = by_class[np.arange(len(votes)), winner]
    total = by_class.sum(1)
    found = objects_of_classes(votes, np.arange(classes, len(labels)), column[classes:], winner, least_share * most)
    label = np.where(found >= 0, classes + found, winner).astype(np.int32)
    label[total <= 0] = UNKNOWN_LABEL
    return label, (most / np.maximum(total, 1e-12)).astype(np.float32)
