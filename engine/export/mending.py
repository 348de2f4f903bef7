"""Clean up a fused surface and cut it by label. Small holes are closed; loose pieces, flaps and narrow strips at edges
are removed; small pieces far from their object lose its label. The cut follows the smooth lines where labels change,
not the triangles, so that parts meet without teeth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..posed.ply import rows_by_label
from .fusion import Ints, SmallView, Surface, neighbours, triangle_normals

Labelled = tuple[Surface, Ints]
"""A surface and the label of each of its vertices, int64 [V]."""

HAND = 0.1
"""The largest size in metres, along each axis, of a hole that is closed. Its square is the largest crumb of stuff."""
FLAKE = 0.03  # area in square metres below which an isolated piece of the whole surface is dropped
CRUMB = 0.1  # share of the largest piece's area below which a piece of a mesh is small
SCRAP = 0.02  # share of the largest piece's area below which a piece of an object's mesh is always a crumb
FAR = 0.2  # metres from the large pieces beyond which a small one is a crumb
STEEPEST = 0.1  # cosine between the normal and the way to a view below which the view does not see it from in front
OFF, OFF_SHARE = 0.05, 0.02  # metres, and the share of the distance, by which depth may differ on one surface
LEAST_PIECE = 100  # triangles below which a piece of a mesh is a crumb, except the largest of an object
FRINGE = 2  # half the width in vertices of a fringe
THIN = 0.5  # share of a label's vertices outside fringes below which the label itself is thin, and keeps its fringes
KEYS = 1 << 32


def close_holes(surface: Surface, label: Ints, largest: float = HAND) -> tuple[Surface, Ints]:
    """Close holes of at most the ``largest`` size in metres, each with a fan of triangles around a new central vertex.
    Returns the surface and its vertices' labels [V]. A hole is a ring of open edges that the surface surrounds; rims of
    small loose pieces stay open."""
    rim = open_edges(surface.triangles)
    if not len(rim):
        return surface, label
    ring, is_hole = _rings(surface, rim, largest)
    rim, ring = rim[is_hole[ring]], ring[is_hole[ring]]
    _, ring, count = np.unique(ring, return_inverse=True, return_counts=True)

    def mean(values: NDArray[np.generic]) -> NDArray[np.float64]:
        """Return the mean of values [rim vertices, ...] over each hole's rim."""
        sums = [np.bincount(ring, column, len(count)) for column in values[rim[:, 0]].T]
        return np.stack(sums, axis=-1) / count[:, None]

    normal = mean(surface.normal)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    middle = len(surface.xyz) + ring
    closed = Surface(
        np.concatenate([surface.xyz, mean(surface.xyz).astype(np.float32)]),
        np.concatenate([surface.rgb, np.rint(mean(surface.rgb)).astype(np.uint8)]),
        np.concatenate([surface.normal, normal.astype(np.float32)]),
        np.concatenate([surface.triangles, np.stack([rim[:, 1], rim[:, 0], middle], axis=-1)]),
    )
    return closed, np.concatenate([label, most_frequent(ring, label[rim[:, 0]], len(count))])


def without_flakes(surface: Surface, label: Ints) -> tuple[Surface, Ints]:
    """Return the surface and its vertices' labels [V] without isolated pieces of less area than FLAKE."""
    piece = pieces(surface.triangles, len(surface.xyz))
    of_triangle = piece[surface.triangles[:, 0]]
    area = np.bincount(of_triangle, _areas(surface.xyz, surface.triangles), len(surface.xyz))
    kept, used = surface.of(surface.triangles[area[of_triangle] >= FLAKE])
    return kept, label[used]


def without_flaps(surface: Surface, label: Ints, views: Sequence[SmallView], steepest: float = STEEPEST) -> Labelled:
    """The surface and its vertices' labels [V] without vertices that stand off: those that more views look through than
    see, and those that no view sees from in front, less steeply than ``steepest``, the cosine towards the view."""
    front, seen, through = np.full(len(label), -1.0, np.float32), *np.zeros((2, len(label)), np.int64)
    around = np.ones((3, 3), np.uint8)
    for view in views:
        vertex, pixel, depth = view.camera.seen(surface.xyz)
        column, row = pixel.astype(np.int64).T
        # Outlines are uncertain by a pixel, so a view sees past a vertex only if all pixels around it do.
        nearest, farthest = cv2.erode(view.depth, around)[row, column], cv2.dilate(view.depth, around)[row, column]
        is_seen = (depth > nearest - OFF) & (depth < farthest + OFF) & (farthest > 0)
        through[vertex] += nearest > depth * (1 + OFF_SHARE) + OFF
        seen[vertex] += is_seen
        towards = view.camera.centre - surface.xyz[vertex[is_seen]]
        cosine = np.einsum("ij,ij->i", towards, surface.normal[vertex[is_seen]]) / np.linalg.norm(towards, axis=1)
        front[vertex[is_seen]] = np.maximum(front[vertex[is_seen]], cosine)
    stands_off = (through > seen) | (front < steepest)
    kept, used = surface.of(surface.triangles[stands_off[surface.triangles].sum(axis=1) < 2])
    return kept, label[used]


def without_fringe(surface: Surface, label: Ints) -> tuple[Surface, Ints]:
    """The surface and its vertices' labels [V] without strips narrower than twice FRINGE vertices between open edges,
    which views leave where one surface hides another. Tubes have no open edges, and THIN labels keep their strips."""
    near = np.zeros(len(label), np.bool_)
    near[open_edges(surface.triangles)] = True
    within = _grown(~_grown(near, surface.triangles, FRINGE - 1), surface.triangles, FRINGE)
    known, index = np.unique(label, return_inverse=True)
    is_thin = (np.bincount(index, within) < THIN * np.bincount(index)) & (known > 0)
    within |= _grown(is_thin[index], surface.triangles, 1)  # with lone vertices of other labels in it
    kept, used = surface.of(surface.triangles[within[surface.triangles].all(axis=1)])
    return kept, label[used]


def _grown(marked: NDArray[np.bool_], triangles: Ints, rounds: int) -> NDArray[np.bool_]:
    """Return which vertices are at most ``rounds`` edges away from those ``marked``, bool [V]."""
    marked = marked.copy()
    for _ in range(rounds):
        marked[triangles[marked[triangles].any(axis=1)]] = True
    return marked


def _rings(surface: Surface, rim: Ints, largest: float) -> tuple[Ints, NDArray[np.bool_]]:
    """Return the ring of each edge of the ``rim``, [E], and which of the rings, [R], are holes to close: at most
    ``largest`` metres in size, and not the rims of small pieces."""
    count = len(surface.xyz)
    number = pieces(rim, count)
    _, ring = np.unique(number[rim[:, 0]], return_inverse=True)
    piece = pieces(surface.triangles, count)
    extent = _extents(surface.xyz[rim[:, 0]], ring)
    reach = _extents(surface.xyz, piece)[piece[rim[:, 0]]]
    is_hole = extent.max(axis=1) <= largest
    comes, goes = np.bincount(rim[:, 1], minlength=count), np.bincount(rim[:, 0], minlength=count)
    is_hole[ring[(comes != goes)[rim[:, 0]] | (comes != goes)[rim[:, 1]]]] = False
    is_hole[ring[(reach < 2 * extent[ring].max(axis=1, keepdims=True)).all(axis=1)]] = False  # rims of small pieces
    return ring, is_hole


def open_edges(triangles: Ints) -> Ints:
    """The edges [E, 2] with a triangle on only one side, in the direction that they have in that triangle [T, 3]."""
    if not len(triangles):
        return np.empty((0, 2), np.int64)
    first, last = triangles.ravel(), triangles[:, [1, 2, 0]].ravel()
    count = int(triangles.max()) + 1
    there = coo_matrix((np.ones(len(first), np.bool_), (first, last)), (count, count)).tocsr()
    return np.stack((there > there.T).nonzero(), axis=-1).astype(np.int64)


def even_rim(surface: Surface) -> NDArray[np.float32]:
    """Return the vertices' positions [V, 3] with open edges smoothed along themselves, so that they have no teeth."""
    xyz, rim = surface.xyz.copy(), open_edges(surface.triangles)
    rim = np.concatenate([rim, rim[:, ::-1]])
    count = np.bincount(rim[:, 0], minlength=len(xyz))
    for _ in range(_ROUNDS):
        sums = np.stack([np.bincount(rim[:, 0], axis, len(xyz)) for axis in xyz[rim[:, 1]].T], axis=-1)
        xyz[count > 0] = (xyz[count > 0] + sums[count > 0] / count[count > 0, None]) / 2
    return xyz


def without_crumbs(surface: Surface, label: Ints, is_stuff: NDArray[np.bool_], least: int = 0) -> Ints:
    """Return the labels [V] without crumbs: small pieces of a label's mesh that are far from its large ones, or tiny. A
    crumb gets the label that most of its neighbours on the surface have, or 0 without neighbours. Stuff, marked by
    ``is_stuff`` [V], is naturally in pieces, such as the wall between two pictures: only its smallest pieces are
    crumbs. So are pieces of fewer than ``least`` triangles, unless they are the largest."""
    number, crumbs, stays = np.full(len(label), -1, np.int64), 0, np.zeros(len(label), np.bool_)
    for value, rows in rows_by_label(surface.triangles, label).items():
        if value == 0:
            continue
        part, used = surface.of(surface.triangles[rows])
        xyz, piece = part.xyz, pieces(part.triangles, len(used))
        area = np.bincount(piece[part.triangles[:, 0]], _areas(xyz, part.triangles))
        own = label[used] == value
        is_large = area >= min(CRUMB * area.max(), HAND**2 if is_stuff[used][own].any() else np.inf)
        away, _ = cKDTree(xyz[is_large[piece]]).query(xyz, distance_upper_bound=FAR)
        is_near = np.bincount(piece, np.isfinite(away)) > 0
        is_scrap = area < (0.0 if is_stuff[used][own].any() else SCRAP * area.max())
        is_scrap |= (np.bincount(piece[part.triangles[:, 0]]) < least) & (area < area.max())
        crumb = own & (~is_near | is_scrap)[piece]
        number[used[crumb]] = crumbs + piece[crumb]
        stays[used[own & ~crumb]] = True
        crumbs += len(area)
    rows = np.flatnonzero(number >= 0)
    row, other = neighbours(surface.triangles, len(label))[rows].nonzero()
    row, other = row[stays[other]], other[stays[other]]
    around = most_frequent(number[rows[row]], label[other], crumbs)
    return np.where(number >= 0, around[number] if crumbs else 0, label)


def most_frequent(group: Ints, label: Ints, groups: int) -> Ints:
    """Return the most frequent label of each group, [groups], by members' ``group`` and ``label`` [N]; 0 for none."""
    known, index = np.unique(label, return_inverse=True)
    pairs, count = np.unique(group * max(len(known), 1) + index, return_counts=True)
    pairs = pairs[np.argsort(count, kind="stable")]  # so that the most frequent is written last
    found = np.zeros(groups, np.int64)
    found[pairs // max(len(known), 1)] = known[pairs % max(len(known), 1)]
    return found


def pieces(joined: Ints, count: int) -> Ints:
    """The number of each vertex's connected piece, int64 [count]. Rows of ``joined`` [N, 2 or 3] connect vertices."""
    first, last = joined[:, :-1].ravel(), joined[:, 1:].ravel()
    graph = coo_matrix((np.ones(len(first), np.int8), (first, last)), (count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _extents(xyz: NDArray[np.float32], group: Ints) -> NDArray[np.float32]:
    """Return the size [G, 3] of the box around each group's points; ``group`` [N] is that of each of ``xyz`` [N, 3]."""
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    return np.maximum.reduceat(xyz[order], starts) - np.minimum.reduceat(xyz[order], starts)


def _areas(xyz: NDArray[np.float32], triangles: Ints) -> NDArray[np.float64]:
    return np.linalg.norm(triangle_normals(xyz, triangles), axis=1) / 2


_ROUNDS = 4  # rounds of smoothing: of rims, and of labels before the line between two is drawn
_MARGIN = 0.15  # minimum share of an edge on each side of a cut: slivers would fold over when a rim is smoothed


def even_labels(triangles: Ints, label: Ints) -> Ints:
    """The labels [V] smoothed: a vertex takes the prevailing label around it, so lone vertices and jags vanish."""
    known, index = np.unique(label, return_inverse=True)
    shares = _shares(triangles, index, len(known)).tocoo()
    order = np.lexsort([shares.data, shares.row])
    row, column = shares.row[order], shares.col[order]
    last = np.flatnonzero(np.diff(row, append=-1))
    return np.asarray(known[column[last]], np.int64)


def cut_by_label(surface: Surface, label: Ints) -> tuple[Surface, Ints]:
    """Cut the surface where its labels [V] change. Returns it with new labels. Each side has its own vertices along the
    cut, at the same positions, so that the corners of a triangle share one label. Rims are smooth."""
    corners, count = label[surface.triangles], len(label)
    alike = (corners == np.roll(corners, -1, axis=1)).sum(axis=1)  # 3: all alike, 1: two, 0: none
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
    """Return where between the ends ``own`` (0) and ``other`` (1) of edges [E] both labels are equally strong, [E]."""
    if not len(own):
        return np.zeros(0)
    known, index = np.unique(label, return_inverse=True)
    shares = _shares(triangles, index, len(known))
    ours, theirs = (
        np.maximum(np.asarray(shares[at, index[at]] - shares[at, index[beyond]]).ravel(), 1e-6)
        for at, beyond in ((own, other), (other, own))
    )
    return np.clip(ours / (ours + theirs), _MARGIN, 1 - _MARGIN)


def around_vertices(triangles: Ints, count: int) -> csr_matrix:
    """Return the sparse matrix [count, count] that averages the neighbours' values for each vertex."""
    beside = neighbours(triangles, count).astype(np.float64)
    return diags(1.0 / np.maximum(np.asarray(beside.sum(axis=1)).ravel(), 1.0)) @ beside


def numbered(group: Ints, kind: Ints, groups: int) -> tuple[Ints, Ints]:
    """Number the different pairs of ``group`` and ``kind`` (0 or more), [N] each. Returns the number of each pair, [N],
    and the group of each number. Only pairs of a group's rarer kinds are sorted."""
    usual = np.full(groups, -1, np.int64)
    usual[group] = kind
    is_usual = usual[group] == kind
    number = (np.cumsum(usual >= 0) - 1)[group]
    there = np.flatnonzero(usual >= 0)
    rest = np.stack([group, kind])[:, ~is_usual]
    order = np.lexsort(rest)
    is_new = np.ones(len(order), np.bool_)
    is_new[1:] = (np.diff(rest[:, order]) != 0).any(axis=0)
    number[np.flatnonzero(~is_usual)[order]] = len(there) + np.cumsum(is_new) - 1
    return number, np.concatenate([there, rest[0, order[is_new]]])


def _shares(triangles: Ints, index: Ints, known: int) -> csr_matrix:
    """Return the share of each of ``known`` labels, by ``index`` [V], around a vertex, [V, known]; rows sum to 1."""
    count = len(index)
    around = around_vertices(triangles, count)
    shares = csr_matrix((np.ones(count), (np.arange(count), index)), (count, known))
    for _ in range(_ROUNDS):
        shares = 0.5 * (shares + around @ shares)
    return shares
