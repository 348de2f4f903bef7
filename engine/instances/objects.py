"""From objects that views agree on to instances with boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..scene import View
from .consensus import MemberMask
from .matching import Evidence, GlobalInstance
from .oriented_box import fit_box


def object_instances(
    views: Sequence[View],
    objects: Sequence[tuple[Sequence[MemberMask], int]],
    xyz: NDArray[np.floating],
    object_of_point: NDArray[np.int32],
    min_thickness: float,
) -> list[GlobalInstance]:
    """The ``objects`` 1.. (the masks of each, and its class) as instances with boxes. Each owns points.

    ``xyz`` [N, 3] metres is the cloud's, ``object_of_point`` int32 [N] the object that each point was decided to belong
    to (0 = none); ``min_thickness`` of a box in metres.
    """
    pixels = {
        (view.name, int(segment)): int(count)
        for view in views
        for segment, count in zip(*np.unique(view.mask.ids[view.depth > 0], return_counts=True), strict=True)
    }
    instances: list[GlobalInstance] = []
    for number, (masks, class_id) in enumerate(objects, start=1):
        points = np.asarray(xyz[object_of_point == number], np.float64)
        evidence = tuple(
            Evidence(
                one.frame,
                one.segment.id,
                one.segment.class_id,
                one.segment.score,
                pixels.get((one.frame, one.segment.id), 0),
                cost=None,
                agreement=one.agreement,
            )
            for one in masks
        )
        instances.append(GlobalInstance(number, points, fit_box(points, min_thickness), evidence, class_id))
    return instances
