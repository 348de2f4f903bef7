"""A labelled surface cut along the lines where its labels change, not along its triangles, so that its parts have no
teeth where they meet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags

from .fusion import Ints, Surface
from .mending import KEYS, even_rim

_ROUNDS = 4
"""How often labels are mixed with those around them before the line between two is drawn."""
_MARGIN = 0.15
"""Least share of an edge on each side of a cut: slivers fold over when a rim is evened."""


def even_labels(triangles: Ints, label: Ints) -> Ints:
    """The labels [V] with each vertex's own replaced by that which prevails around it: no lone vertices, no jags."""
    known, place = np.unique(label, return_inverse=True)
    shares = _shares(triangles, place, len(known)).tocoo()
    order = np.lexsort([shares.data, shares.row])
    row, column = shares.row[order], shares.col[order]
    last = np.flatnonzero(np.diff(row, append=-1))
    return np.asarray(known[column[last]], np.int64)


def cut_by_label(surface: Surface, label: Ints) -> tuple[Surface, Ints]:
    """The surface cut where its labels [V] change, and the new labels. All corners of a triangle then have one label,
    as each side has vertices of its own along the cut, in the same places, and rims are even."""
    corners, count = label[surface.triangles], len(label)
    alike = (corners == np.roll(corners, -1, axis=1)).sum(axis=1)
    two, three = surface.triangles[alike == 1], surface.triangles[alike == 0]
    a, b, c = label[two].T
    lone = np.where(b == c, 0, np.where(a == c, 1, 2))[:, None]  # the corner that has its label alone
    tip, left, right = np.take_along_axis(two, (lone + np.arange(3)) % 3, axis=1).T
    x, y, z = three.T
    own = np.concatenate([tip, tip, left, right, x, x, y, y, z, z])
    other = np.concatenate([left, right, tip, tip, y, z, z, x, x, y])
    pairs, number = np.unique(own * KEYS + other, return_inverse=True)
    tip_left, tip_right, to_left, to_right = (count + number[: 4 * len(two)]).reshape(4, -1)
    xy, xz, yz, yx, zx, zy = (count + number[4 * len(two) :]).reshape(6, -1)
    in_x, in_y, in_z = count + len(pairs) + np.arange(3 * len(three)).reshape(3, -1)
    parts = [(tip, tip_left, tip_right), (to_left, left, right), (to_left, right, to_right)]
    for corner, first, middle, last in ((x, xy, in_x, xz), (y, yz, in_y, yx), (z, zx, in_z, zy)):
        parts += [(corner, first, middle), (corner, middle, last)]
    own, other = np.divmod(pairs, KEYS)
    along = _along(surface.triangles, label, own, other)[:, None]
    inner = np.concatenate([x, y, z])

    def extended(values: NDArray[np.float32]) -> NDArray[np.float32]:
        between = values[own] + along * (values[other] - values[own])
        return np.concatenate([values, between, np.tile(values[three].mean(axis=1), (3, 1))]).astype(np.float32)

    normal = extended(surface.normal)
    cut = Surface(
        extended(surface.xyz),
        np.concatenate([surface.rgb, surface.rgb[own], surface.rgb[inner]]),  # an object's colours end where it does
        normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.float32(1e-9)),
        np.concatenate([surface.triangles[alike == 3], *(np.stack(part, axis=-1) for part in parts)]),
    )
    xyz = even_rim(cut)
    # Each side was evened alone. Its copies of one place come together again, so that no gaps open.
    between, middles = np.split(xyz[count:], [len(pairs)])
    between[:] = (between + between[np.searchsorted(pairs, other * KEYS + own)]) / 2
    middles[:] = np.tile(middles.reshape(3, -1, 3).mean(axis=0), (3, 1))
    return Surface(xyz, cut.rgb, cut.normal, cut.triangles), np.concatenate([label, label[own], label[inner]])


def _along(triangles: Ints, label: Ints, own: Ints, other: Ints) -> NDArray[np.float64]:
    """Where on each edge, from its ``own`` vertex [E] to the ``other``, the labels of both count the same, 0 to 1."""
    if not len(own):
        return np.zeros(0)
    known, place = np.unique(label, return_inverse=True)
    shares = _shares(triangles, place, len(known))
    ours, theirs = (
        np.maximum(np.asarray(shares[at, place[at]] - shares[at, place[beyond]]).ravel(), 1e-6)
        for at, beyond in ((own, other), (other, own))
    )
    return np.clip(ours / (ours + theirs), _MARGIN, 1 - _MARGIN)


def _shares(triangles: Ints, place: Ints, known: int) -> csr_matrix:
    """How much each label counts around each vertex, [V, known], in sum 1."""
    count = len(place)
    edges = triangles[:, [0, 1, 1, 2, 2, 0, 1, 0, 2, 1, 0, 2]].reshape(-1, 2)
    beside = coo_matrix((np.ones(len(edges)), tuple(edges.T)), (count, count)).tocsr()
    beside.data[:] = 1.0
    around = diags(1.0 / np.maximum(np.asarray(beside.sum(axis=1)).ravel(), 1.0)) @ beside
    shares = csr_matrix((np.ones(count), (np.arange(count), place)), (count, known))
    for _ in range(_ROUNDS):
        shares = 0.5 * (shares + around @ shares)
    return shares
