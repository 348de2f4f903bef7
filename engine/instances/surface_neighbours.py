"""Neighbouring points of one surface, which share their votes (ours, beyond the paper).

A point that few views see has few votes, and ragged masks leave it with wrong ones. Its neighbours on the same thing
know better. Two points are on one thing if most views, by what they resolve, show both in one segment. So votes do not
cross the outline of a picture or a rug in the plane of its wall or floor. OVSeg3R (arXiv 2509.23541) cuts its
superpoints at such outlines; there are no superpoints here.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from ..machine.threads import worker_count
from .agreement import ViewPoints

NEIGHBOURS = 6
"""The most neighbours of a point, as in a plane of cells that are packed closely."""
REACH = 2.0
"""Neighbours are within this many spacings of the cloud."""


def neighbours_on_a_thing(xyz: NDArray[np.floating], spacing: float, seen: Iterable[ViewPoints]) -> Any:
    """The weight of each point's neighbours, sparse float32 [N, N]. A row's sum is 1, or 0 for a point without any.

    ``xyz`` [N, 3] and ``spacing`` of the cloud in metres; ``seen``: what each view shows at the points.
    """
    points, count = np.asarray(xyz, np.float64), len(xyz)
    reach = np.nextafter(REACH * spacing, np.inf)
    nearest = cKDTree(points).query(points, NEIGHBOURS + 1, distance_upper_bound=reach, workers=worker_count())[1]
    other = nearest[:, 1:]  # without the point itself; N stands for no neighbour
    both, same = np.zeros(other.shape, np.float32), np.zeros(other.shape, np.float32)
    segment, resolution = np.zeros(count + 1, np.int32), np.zeros(count + 1, np.float32)
    for one in seen:
        segment[one.row], resolution[one.row] = one.segment, one.resolution
        there, here = segment[other[one.row]], one.segment[:, None]
        weight = np.minimum(resolution[other[one.row]], one.resolution[:, None]) * ((there > 0) & (here > 0))
        both[one.row] += weight
        same[one.row] += weight * (there == here)
        segment[one.row] = 0
    share = np.where(same > 0.5 * both, same / np.maximum(both, 1e-12), 0.0)
    weight = share / np.maximum(share.sum(1, keepdims=True), 1e-12)
    row, place = np.nonzero(share)
    return sparse.csr_matrix((weight[row, place].astype(np.float32), (row, other[row, place])), (count, count))
