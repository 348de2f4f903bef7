"""The rule by which a point, a pixel and a Gaussian decide what they show: class first, then the object of that class.

Each has some coverage of every class, including the coverage of the class's objects. The largest class wins. Its
largest object is shown if it has enough of the class; otherwise the class is shown alone. So an object is never shown
with a class other than its own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..machine.compiled import Array, compiled, device_function

LEAST_OF_CLASS = 0.1
"""Share of its class's coverage that an object needs to be shown."""


@device_function
def object_of_class(shown: Array, places: Array, class_of_object: Array, wanted: int, least: float) -> int:
    """The object 0..U-1 of class ``wanted`` with the largest coverage (the first if several tie); -1 if none has more
    than ``least``.

    ``shown`` [W] holds at ``places`` int64 [U] the coverage of each object, ``class_of_object`` [U] its class.
    """
    best, most = -1, least
    for number in range(len(places)):
        if class_of_object[number] == wanted and shown[places[number]] > most:
            best, most = number, shown[places[number]]
    return best


def objects_of_classes(
    shown: NDArray[np.floating],
    places: NDArray[np.int64],
    class_of_object: NDArray[np.integer],
    wanted: NDArray[np.integer],
    least: NDArray[np.floating],
) -> NDArray[np.int64]:
    """``object_of_class`` for each row of ``shown`` [N, W], int64 [N]; ``wanted`` and ``least`` are [N]."""
    found = np.empty(len(shown), np.int64)
    classes, rows = class_of_object.astype(np.int64), np.ascontiguousarray(shown)
    _fill_objects(rows, places, classes, wanted.astype(np.int64), least, found)
    return found


@compiled
def _fill_objects(
    shown: Array, places: Array, class_of_object: Array, wanted: Array, least: Array, found: Array
) -> None:
    """The loop behind ``objects_of_classes``."""
    for row in range(len(shown)):
        found[row] = object_of_class(shown[row], places, class_of_object, wanted[row], least[row])
