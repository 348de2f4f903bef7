"""Rectify a plane as the photos show it: its colours, its labels, and which part of it only removed objects hide."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_fill_holes, distance_transform_edt, map_coordinates
from scipy.ndimage import label as components

from .leaving import Leaving
from .planes import ON_PLANE, Plane
from .views import PlateView

EVERY, FARTHEST = 4, 12.0
"""One of this many rows and columns of a photo, and metres from it, in which hidden parts of a plane are sought."""
COARSE = 0.04
"""Metres, the side of a texel of the first look at a plane."""
FINEST, COARSEST = 0.006, 0.02
"""Metres, the limits of a texel's side."""
MOST_TEXELS = 60000
CONTEXT = 0.7
"""Metres of the plane around the hole, which show its light and its pattern."""
MOSTLY = 0.4
"""Of the photos that show something before a texel, the share that show what leaves before it, where it hides it."""
POORLY = 3.0
"""Where this many times as many photos show what leaves before a texel as show the texel itself, the lift shows it
badly, and the photos' colours replace the lift's."""
FRAMED = 0.5
"""Least share of a hole's edge at which photos saw the plane. A plane that merely passes by has less."""
GRAZING = 0.05
"""Least cosine between a view and the plane's normal."""
THROUGH = 0.1
"""Metres behind a plane at which a photo that measures them looks through it."""
STANDS_OVER = 0.6
"""Metres above a plane within which what leaves stands over it."""
FLAT_THING, LOW = 0.8, 0.04
"""Least share of a thing's pixels that lie within ``LOW`` metres of a plane for it to lie flat there, as a rug does."""

Mask = NDArray[np.bool_]


@dataclass(eq=False)
class Texture:
    """A rectangle of a plane, of [h, w] texels with sides of ``texel`` metres; ``low`` [2] is its corner in the plane.
    Per texel: ``colour`` [h, w, 3]; ``seen`` by a photo; ``hidden`` in every photo by removed objects; ``label`` int32
    (see PlateView); ``inside`` the room and some photo's view; ``open`` where photos look through the plane; ``poorly``
    seen: most photos of it show removed objects."""

    plane: Plane
    low: NDArray[np.float64]
    texel: float
    colour: NDArray[np.float32]
    seen: Mask
    hidden: Mask
    label: NDArray[np.int32]
    inside: Mask
    open: Mask
    poorly: Mask

    def points(self) -> NDArray[np.float64]:
        """Return the centre of each texel in the world, [h, w, 3]."""
        return grid(self.plane, self.low, self.texel, self.seen.shape)

    def hole(self) -> Mask:
        """Return the hidden part of the plane, and the rim between that and what photos saw, as far as photos saw the
        plane around it; bool [h, w]."""
        if not self.hidden.any():
            return self.hidden
        reach = max(0.1, 2 * self.texel)
        rim = ~self.seen & self.inside & ~self.open & (distance_transform_edt(~self.hidden) * self.texel <= reach)
        return _framed(self.hidden | rim, self.seen, self.inside) & ~self.open

    def below(self, leaving: Leaving) -> Mask:
        """Return the texels of the plane that lie straight below the removed objects, bool [h, w]."""
        local = self.plane.local(leaving.xyz)
        h, w = self.seen.shape
        x, y = np.floor((local[:, :2] - self.low) / self.texel).astype(int).T
        over = (x >= 0) & (x < w) & (y >= 0) & (y < h) & (local[:, 2] > -0.05) & (local[:, 2] < STANDS_OVER)
        mask = np.zeros((h, w), np.bool_)
        mask[y[over], x[over]] = True
        return closed(mask, 3)


def grid(plane: Plane, low: NDArray[np.float64], texel: float, shape: tuple[int, ...]) -> NDArray[np.float64]:
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    return plane.world(low + (np.stack([x, y], axis=-1) + 0.5) * texel)


def closed(mask: Mask, radius: int) -> Mask:
    """Close gaps in a mask that are at most twice the ``radius`` wide, in texels."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    wide = cv2.morphologyEx(np.pad(mask, radius + 1).astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    return np.asarray(wide[radius + 1 : -radius - 1, radius + 1 : -radius - 1])


def texture_around(
    plane: Plane, solid: Sequence[Plane], views: Sequence[PlateView], leaving: Leaving
) -> Texture | None:
    """Return the texture of a plane around the removed objects; None if they hid nothing of it. Parts behind a
    ``solid`` plane are not inside."""
    behind = np.concatenate([plane.local(leaving.xyz)[:, :2], *(_behind(plane, view) for view in views)])
    start, end = np.percentile(behind, (1, 99), axis=0) + [[-0.3], [0.3]]
    flat = _flat_things(plane, views)
    coarse = _look(plane, solid, views, flat, start, end, COARSE)
    if coarse is None:
        return None
    near = coarse.hole() | coarse.poorly | (coarse.below(leaving) & binary_dilation(coarse.seen, np.ones((5, 5))))
    y, x = np.nonzero(near)
    if not len(x):
        return None
    first = start + (np.array([x.min(), y.min()]) - 1) * COARSE - CONTEXT
    last = start + (np.array([x.max(), y.max()]) + 2) * COARSE + CONTEXT
    middle = plane.world((first + last) / 2)
    sizes = [z / view.camera.fx for view in views for _, z in [view.camera.project(middle)] if z > 0.3]
    texel = float(np.clip(np.percentile(sizes, 15), FINEST, COARSEST)) if sizes else COARSEST
    texel = max(texel, float(np.sqrt((last - first).prod() / MOST_TEXELS)))
    return _look(plane, solid, views, flat, first, last, texel)


def _behind(plane: Plane, view: PlateView) -> NDArray[np.float64]:
    """Return where on the plane, [N, 2], a view's rays that meet removed objects would end without them."""
    measured = np.where(view.leaves, view.depth, 0)[::EVERY, ::EVERY]
    seen = view.camera.resized(measured.shape[1], measured.shape[0]).unproject(measured)[measured > 0]
    ways, height = seen - view.camera.centre, plane.local(view.camera.centre[None])[0, 2]
    falls = -(ways @ plane.axes[2])
    times = height / np.where(falls > 1e-6, falls, np.inf)
    found = times > 0.98  # on the removed objects, or behind them
    ends = plane.local(view.camera.centre + times[found, None] * ways[found])[:, :2]
    return ends[np.linalg.norm(times[found, None] * ways[found], axis=1) < FARTHEST]


def _flat_things(plane: Plane, views: Sequence[PlateView]) -> set[int]:
    """Return the ids of things that stay and lie flat on the plane."""
    ids = 1 + max([0, *(int(view.label.max()) for view in views)])
    low, seen = np.zeros((2, ids), np.int64)
    for view in views:
        of_thing = (view.label > 0) & (view.depth > 0) & ~view.beside
        own, height = view.label[of_thing], plane.local(view.camera.unproject(view.depth)[of_thing])[:, 2]
        low += np.bincount(own[np.abs(height) < LOW], minlength=ids)
        seen += np.bincount(own, minlength=ids)
    return {*np.flatnonzero(low > FLAT_THING * seen).tolist()}


class _Sums:
    """Sums over views of what they show of N texels."""

    def __init__(self, count: int) -> None:
        self.colour, self.weight = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
        self.shown, self.covered, self.hidden = np.zeros((3, count), np.int32)
        self.open = np.zeros(count, np.bool_)
        self.votes: dict[int, NDArray[np.float32]] = {}

    def add(self, plane: Plane, view: PlateView, xyz: NDArray[np.float64]) -> None:
        """Add what a view shows of the texels at ``xyz`` [N, 3]."""
        rows, pixel, depth = view.camera.seen(xyz)
        away = view.camera.centre - xyz[rows]
        facing = away @ plane.axes[2] / np.linalg.norm(away, axis=1)
        front = (facing > GRAZING) & (depth > 0.1)
        rows, pixel, depth, facing = rows[front], pixel[front], depth[front], facing[front]
        column, row = pixel.astype(np.int64).T
        measured = view.depth[row, column]
        covered = (measured < depth - 0.01) & (measured > 0)
        self.covered[rows[covered]] += 1
        self.hidden[rows[covered & view.leaves[row, column]]] += 1
        slant = depth / view.camera.fx * np.sqrt(1 - facing**2) / facing  # metres of depth from pixel to pixel
        self.open[rows[measured > depth + THROUGH + 2 * slant]] = True
        good = (measured > 0) & (np.abs(measured - depth) < np.minimum(ON_PLANE + 0.01 * depth + slant, 0.06))
        steps = cv2.dilate(view.depth, np.ones((3, 3))) - cv2.erode(view.depth, np.ones((3, 3)))
        good &= ~view.beside[row, column] & (steps[row, column] < 4 * slant + 0.03)  # at an edge, colours mix
        rows, pixel = rows[good], pixel[good]
        strength = ((facing[good] / depth[good] ** 2) ** 2).astype(np.float32)
        for channel in range(3):
            sampled = map_coordinates(view.colour[..., channel], pixel.T[::-1] - 0.5, order=1, mode="nearest")
            self.colour[rows, channel] += strength * sampled
        self.weight[rows] += strength
        self.shown[rows] += 1
        kind = view.label[row[good], column[good]]
        for one in np.unique(kind).tolist():
            self.votes.setdefault(one, np.zeros(len(xyz), np.float32))[rows[kind == one]] += strength[kind == one]


def _look(
    plane: Plane, solid: Sequence[Plane], views: Sequence[PlateView], flat: Collection[int],
    start: NDArray[np.float64], end: NDArray[np.float64], texel: float,
) -> Texture | None:  # fmt: skip
    """Return the texture, in texels of ``texel`` metres, of the rectangle from ``start`` to ``end`` of a plane on which
    the ``flat`` things lie. Returns None if no photo shows it, or if it is a thing's side. What is behind a ``solid``
    plane is not inside."""
    w, h = np.ceil((end - start) / texel).astype(int).tolist()
    xyz = grid(plane, start, texel, (h, w)).reshape(-1, 3)
    sums, inside = _Sums(h * w), np.ones(h * w, np.bool_)
    for other in solid:
        inside &= other.local(xyz)[:, 2] > -ON_PLANE
    for view in views:
        sums.add(plane, view, xyz)
    inside &= (sums.covered > 0) | (sums.weight > 0) | sums.open
    votes = {one: each for one, each in sums.votes.items() if one != 0}
    if not votes:
        return None
    most = max(votes, key=lambda one: float(votes[one].sum()))
    if most > 0 and most not in flat and not plane.is_floor:
        return None  # a table's top carries things, its side does not
    lies = most < 0 or most in flat  # else it is a table's top: what photos call floor there is noise
    also = flat if plane.is_floor else ()  # rugs go on; a wall's pictures do not go on behind a television
    votes = {one: each for one, each in votes.items() if one == most or one in also or (one < 0 and lies)}
    names = np.array(sorted(votes), np.int32)
    counted = np.stack([votes[one] for one in names.tolist()])
    seen = counted.any(axis=0).reshape(h, w)
    label = np.where(seen, names[counted.argmax(axis=0)].reshape(h, w), 0).astype(np.int32)
    label[seen] = cv2.medianBlur(label.astype(np.float32), 5).astype(np.int32)[seen]
    is_open = sums.open & (sums.weight == 0)
    hidden = (sums.hidden >= MOSTLY * sums.covered) & (sums.hidden > 0) & (sums.weight == 0) & inside & ~is_open
    colour = (sums.colour / np.maximum(sums.weight, 1e-9)[:, None]).reshape(h, w, 3)
    poorly = sums.hidden > POORLY * sums.shown
    hidden, inside, is_open, poorly = (each.reshape(h, w) for each in (hidden, inside, is_open, poorly))
    seen &= label != 0
    return Texture(plane, start, texel, colour, seen, hidden, label, inside, is_open, seen & poorly)


def _framed(hole: Mask, seen: Mask, inside: Mask) -> Mask:
    """Return the parts of the ``hole`` whose surroundings are mostly ``seen`` by photos, bool [h, w]."""
    part, count = components(hole)
    kept = np.zeros_like(hole)
    for number in range(1, count + 1):
        one = np.pad(part == number, 3)
        edge = binary_dilation(one, iterations=3) & ~one & np.pad(inside, 3, constant_values=True)
        if one.sum() >= 2 and edge.any() and np.pad(seen, 3)[edge].mean() >= FRAMED:
            kept |= one[3:-3, 3:-3]
    return np.asarray(binary_fill_holes(closed(kept, 5)) & inside) if kept.any() else kept
