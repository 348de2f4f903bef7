"""From objects that views agree on to instances with boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..scene import View
from .consensus import ObjectMasks
from .matching import Evidence, GlobalInstance
from .oriented_box import fit_box


def object_instances(
    views: Sequence[View],
    objects: ObjectMasks,
    xyz: NDArray[np.floating],
    class_of_object: NDArray[np.int32],
    object_of_point: NDArray[np.int32],
    min_thickness: float,
) -> tuple[list[GlobalInstance], NDArray[np.int32]]:
    """The objects that own points, ids 1.. in the order of the objects, and the instance of each point, int32
    [N], 0 = none.

    ``xyz`` [N, 3] metres is the cloud's, ``object_of_point`` int32 [N] the object that each point was decided to belong
    to (0 = none), ``class_of_object`` int32 [objects + 1]; ``min_thickness`` of a box in metres.
    """
    pixels = {
        (view.name, int(segment)): int(count)
        for view in views
        for segment, count in zip(*np.unique(view.mask.ids[view.depth > 0], return_counts=True), strict=True)
    }
    instances: list[GlobalInstance] = []
    instance_of_point = np.zeros(len(xyz), np.int32)
    for number, masks in enumerate(objects.masks, start=1):
        own = object_of_point == number
        if not own.any():
            continue
        evidence = tuple(
            Evidence(frame, segment.id, segment.class_id, segment.score, pixels.get((frame, segment.id), 0), None)
            for frame, segment in masks
        )
        points = np.asarray(xyz[own], np.float64)
        box = fit_box(points, min_thickness)
        instances.append(GlobalInstance(len(instances) + 1, points, box, evidence, int(class_of_object[number])))
        instance_of_point[own] = len(instances)
    return instances, instance_of_point
