"""From objects that views agree on to instances with boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

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
            Evidence(
                one.frame,
                one.segment.id,
                one.segment.class_id,
                one.segment.score,
                pixels.get((one.frame, one.segment.id), 0),
                cost=None,
                consent=one.consent,
            )
            for one in masks
        )
        points = np.asarray(xyz[own], np.float64)
        box = fit_box(points, min_thickness)
        instances.append(GlobalInstance(len(instances) + 1, points, box, evidence, int(class_of_object[number])))
        instance_of_point[own] = len(instances)
    return instances, instance_of_point


def without_strays(
    xyz: NDArray[np.floating], object_of_point: NDArray[np.int32], reach: float, least_share: float = 0.3
) -> NDArray[np.int32]:
    """``object_of_point`` int32 [N] with the stray points of each object set to 0.

    A mask's ragged edge leaves crumbs on the wall behind, which would blow the object's box up to the whole room.
    Points of an object hang together over gaps of at most ``reach`` metres; of the pieces that come of it those with
    fewer than ``least_share`` of the largest one's points are strays.
    """
    kept = object_of_point.copy()
    for number in range(1, int(object_of_point.max(initial=0)) + 1):
        rows = np.flatnonzero(object_of_point == number)
        if len(rows) < 2:
            continue
        piece = _pieces(np.asarray(xyz[rows], np.float64), reach)
        size = np.bincount(piece)
        kept[rows[size[piece] < least_share * size.max()]] = 0
    return kept


def _pieces(points: NDArray[np.float64], reach: float) -> NDArray[np.int32]:
    """Which connected piece each point [n, 3] is in, int32 [n]: points nearer than ``reach`` metres hang together."""
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    piece: NDArray[np.int32] = connected_components(graph, directed=False)[1]
    return piece
