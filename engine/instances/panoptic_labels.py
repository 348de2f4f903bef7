"""Panoptic labels, one number for class and object together, and the rule by which points, pixels and Gaussians decide
which label they show: first the class, then the object of that class. A label is either an object, which implies the
object's class, or a class alone: for stuff, and for things that belong to no object. The coverage of a class includes
that of its objects. The class with the largest coverage wins; its largest object is shown if it has enough of the
class's coverage, else the class alone. So no object is ever shown with a class other than its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..machine.compiled import Array, compiled, device_function

LEAST_OF_CLASS = 0.1
"""Minimum fraction of its class's coverage for an object to be shown."""


@device_function
def object_of_class(shown: Array, columns: Array, class_of_object: Array, wanted: int, least: float) -> int:
    """Return the index of the object of class ``wanted`` with the largest coverage (the first, in a tie), or -1 if none
    has more than ``least``. Object u has coverage shown[columns[u]] and class class_of_object[u]."""
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
    """Return, for each row of ``shown`` [N, W], the index of the object of class ``wanted`` [N] with the largest
    coverage shown[row, columns[index]], int64 [N], or -1 if none has more than ``least`` [N]."""
    found = np.empty(len(shown), np.int64)
    classes, rows = class_of_object.astype(np.int64), np.ascontiguousarray(shown)
    _fill_objects(rows, columns, classes, wanted.astype(np.int64), least, found)
    return found


@compiled
def _fill_objects(
    shown: Array, columns: Array, class_of_object: Array, wanted: Array, least: Array, found: Array
) -> None:
    """The compiled loop of ``objects_of_classes``, with the same arguments, which fills ``found`` [N]."""
    for row in range(len(shown)):
        found[row] = object_of_class(shown[row], columns, class_of_object, wanted[row], least[row])


@dataclass(frozen=True)
class ClassBalance:
    """Weights by which votes for each class are multiplied, ``weights`` [C], unless one class has at least the share
    ``majority`` of all votes. By default all votes count alike."""

    weights: tuple[float, ...] = ()
    majority: float = 0.0

    def of(self, votes: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return ``votes`` [N, C] multiplied by the weights, except rows with a clear majority."""
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
    """The labels of a scene: 0 to C - 1 are the classes ``class_ids`` without an object, C to C + U - 1 are objects 1
    to U, of classes ``class_of_object``. ``balance``: how much votes for each class count."""

    class_ids: tuple[int, ...]
    class_of_object: tuple[int, ...]
    balance: ClassBalance = UNBALANCED

    def __len__(self) -> int:
        return len(self.class_ids) + len(self.class_of_object)

    @property
    def class_column(self) -> NDArray[np.int64]:
        """The index in ``class_ids`` of each label's class, int64 [C + U]."""
        objects = np.searchsorted(self.class_ids, self.class_of_object)
        return np.concatenate([np.arange(len(self.class_ids)), objects]).astype(np.int64)

    def of_class(self, class_id: int) -> int:
        """Return the label of a class without an object; ``UNKNOWN_LABEL`` if it is not in ``class_ids``."""
        return self.class_ids.index(class_id) if class_id in self.class_ids else UNKNOWN_LABEL

    def of_object(self, number: int) -> int:
        """Return the label of an object, given its number, from 1 to U."""
        return len(self.class_ids) + number - 1

    def of_points(self, class_id: NDArray[np.int32], number: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the labels int32 [N] for class ids int32 [N] (0 = unknown) and object numbers int32 [N] (0 = none)."""
        column = np.minimum(np.searchsorted(self.class_ids, class_id), len(self.class_ids) - 1)
        of_class = np.where(np.asarray(self.class_ids)[column] == class_id, column, UNKNOWN_LABEL)
        return np.where(number > 0, number + len(self.class_ids) - 1, of_class).astype(np.int32)

    def classes(self, labels: NDArray[np.integer]) -> NDArray[np.int32]:
        """Return the class id of each label, int32 of the same shape, 0 = unknown."""
        table = np.append(np.asarray(self.class_ids, np.int32)[self.class_column], 0).astype(np.int32)  # last: for -1
        return table[labels]

    def objects(self, labels: NDArray[np.integer]) -> NDArray[np.int32]:
        """Return the object number of each label, int32 of the same shape, 0 = none or unknown."""
        found = np.asarray(labels, np.int32) - (len(self.class_ids) - 1)
        return np.maximum(found, 0)


def decide_labels(
    votes: NDArray[np.floating], labels: PanopticLabels, least_share: float
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the label of each row of votes [N, C + U], int32 [N], and its class's share of the votes, float32 [N], by
    this module's rule: class first. An object's votes also count for its class; to be shown, it needs the share
    ``least_share`` of that class's votes. Ties go to the lower label; rows without votes are unknown."""
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
