"""Superpoints: pieces of surface found by geometry alone, for masks that do not agree (ours, beyond the paper). Points
on one smooth or convex piece of surface are most often on one thing. If views contradict each other, this tells more
than their masks. If masks are good, it harms: a picture lies in the plane of its wall. So it is decided scene by scene:
each view is held back in turn and compared with the votes of the others, by point and by superpoint. The pieces are
found as by Felzenszwalb and Huttenlocher (2004), from angles between normals of neighbours."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from ..machine.compiled import compiled
from ..machine.threads import worker_count
from ..presets.preset import EvidenceKind
from .agreement import ViewsOnCloud, votes_of_views

log = logging.getLogger("plgs.lift")

LOOSENESS = 0.01
"""How much more an edge may bend than the pieces that it joins, divided by their sizes."""
LEAST_POINTS = 20
"""Smaller pieces join the neighbour with the least bend."""
REACH = 1.8
"""Points nearer than this times the cloud's spacing are neighbours."""
PATCH = 12
"""The number of points that a normal is fitted to."""
AGREEING = 0.78
"""Views that agree with the others on less than this share of what they show are weak evidence. Two small networks'
masks had 0.66 to 0.77 (docs/experiments.md), other networks' 0.84 to 0.93, made masks 0.75 to 0.90."""
TOLERANCE = 0.02
"""Superpoints are trusted although agreement falls by this share with them: about what voxels and ragged masks cost."""


def trusted_superpoints(
    xyz: NDArray[np.floating],
    spacing: float,
    seeing: ViewsOnCloud,
    class_ids: tuple[int, ...],
    kind: EvidenceKind,
    *,
    masks_are_weak: bool,
) -> NDArray[np.int64] | None:
    """Return the superpoint of each of a cloud's points ``xyz`` [N, 3], metres, int64 [N], or None if superpoints would
    harm. They are used if views agree too little to judge them, or if ``masks_are_weak`` and views that are held back
    agree with them about as well as with points. ``spacing``: metres between points; ``kind``: that of votes."""
    if len(xyz) < LEAST_POINTS:
        return None
    part = superpoints(xyz, spacing, seeing)
    by_point, by_part = held_back_agreement(part, seeing, class_ids, kind)
    are_trusted = by_point < AGREEING or (masks_are_weak and by_part >= by_point - TOLERANCE)
    log.info(
        "held-out views agree with the others on %.3f of the points, on %.3f with %d superpoints: these are%s used",
        by_point, by_part, part.max() + 1, "" if are_trusted else " not",
    )  # fmt: skip
    return part if are_trusted else None


class RestOfSuperpoint:
    """Acts as a matrix [N, N] that is multiplied by votes [N, labels]: each point gets the votes of all other points in
    its superpoint. With ``mean``, it gets the superpoint's mean votes: a picture can keep its label on a wall."""

    def __init__(self, part: NDArray[np.int64], mean: bool = False) -> None:
        self._member = sparse.csr_matrix((np.ones(len(part), np.float32), (part, np.arange(len(part)))))
        self._mean = sparse.diags((1 / np.bincount(part)).astype(np.float32)) if mean else None

    def __matmul__(self, own: Any) -> Any:
        votes = self._member @ own
        return self._member.T @ votes - own if self._mean is None else self._member.T @ (self._mean @ votes)


def rest_of_superpoints(part: NDArray[np.int64], in_all: float) -> RestOfSuperpoint:
    """Return the matrix that gives points the votes of their superpoint ``part`` [N]: the mean of all its votes, if
    views agree on at least the share AGREEING (``in_all`` is theirs), else the sum of all other points' votes."""
    return RestOfSuperpoint(part, mean=in_all >= AGREEING)


def superpoints(xyz: NDArray[np.floating], spacing: float, seeing: ViewsOnCloud) -> NDArray[np.int64]:
    """Return each point's superpoint, int64 [N], from 0. ``xyz`` [N, 3], ``spacing``: metres; ``seeing``: its views."""
    xyz = np.asarray(xyz, np.float64)
    tree = cKDTree(xyz)
    near = xyz[tree.query(xyz, min(PATCH, len(xyz)), workers=worker_count())[1].reshape(len(xyz), -1)]
    offset = near - near.mean(1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 0]  # 0: the least spread
    towards = np.zeros_like(xyz)
    for view, seen in zip(seeing.views, seeing.seen, strict=True):
        towards[seen.row] += view.camera.centre - xyz[seen.row]
    normal = normal * np.where((normal * towards).sum(1) < 0, -1, 1)[:, None]  # towards the cameras
    one, two = tree.query_pairs(REACH * spacing, output_type="ndarray").T
    bend = 1 - (normal[one] * normal[two]).sum(1)
    is_convex = ((xyz[two] - xyz[one]) * normal[two]).sum(1) > 0
    bend[is_convex] **= 2  # things bulge, and meet others in concave edges
    order = np.lexsort((two, one, bend))  # ties by index, in whatever order the pairs come
    part = _pieces(one[order], two[order], bend[order], len(xyz), LOOSENESS, LEAST_POINTS)
    return np.unique(part, return_inverse=True)[1].astype(np.int64)


@compiled
def _pieces(one: Any, two: Any, bend: Any, points: int, looseness: float, least: int) -> Any:
    """Join points along edges ``one``-``two`` [E], sorted by ``bend``, into pieces of at least ``least`` points. A
    larger ``looseness`` lets pieces bend more. Return each point's piece, int64 [points]."""
    parent, size, limit = np.arange(points), np.ones(points, np.int64), np.full(points, looseness)
    for only_small in (False, True):  # first by bend, then what is still too small
        for edge in range(len(one)):
            i, j = one[edge], two[edge]
            while parent[i] != i:
                parent[i] = parent[parent[i]]  # halves the path for later searches
                i = parent[i]
            while parent[j] != j:
                parent[j] = parent[parent[j]]
                j = parent[j]
            if i == j:
                continue
            if (only_small and min(size[i], size[j]) < least) or (
                not only_small and bend[edge] <= limit[i] and bend[edge] <= limit[j]
            ):
                parent[j] = i
                size[i] += size[j]
                limit[i] = bend[edge] + looseness / size[i]
    for point in range(points):
        root = point
        while parent[root] != root:
            root = parent[root]
        parent[point] = root
    return parent


def held_back_agreement(
    part: NDArray[np.int64], seeing: ViewsOnCloud, class_ids: tuple[int, ...], kind: EvidenceKind
) -> tuple[float, float]:
    """Return two shares, 0 to 1, of the classes that frames show when held back in turn: what agrees with the votes of
    the other frames on the same point, and with their votes on its whole superpoint. For a point that no other frame
    sees, the superpoint's votes count in both."""
    ids, points = np.asarray(class_ids), len(part)
    said, total = votes_of_views(seeing, points, ids, kind)
    of_part = sparse.csr_matrix((np.ones(points), (part, np.arange(points)))) @ total
    asked = by_point = by_part = 0.0
    for numbers in seeing.by_frame():
        row, column, weight = (np.concatenate([said[number][k] for number in numbers]) for k in range(3))
        seen, at = np.unique(row, return_inverse=True)
        others = total[seen]
        np.subtract.at(others, (at, column), weight)
        parts, part_of_row = np.unique(part[row], return_inverse=True)
        rest = of_part[parts]
        np.subtract.at(rest, (part_of_row, column), weight)
        whole = np.where(rest.max(1, initial=0) > 1e-5, rest.argmax(1), -1)[part_of_row]
        each = np.where(others.max(1, initial=0) > 1e-5, others.argmax(1), -1)[at]
        each = np.where(each >= 0, each, whole)
        asked += float(weight[each >= 0].sum())
        by_point += float(weight[each == column].sum())
        by_part += float(weight[whole == column].sum())
    return by_point / max(asked, 1e-9), by_part / max(asked, 1e-9)
