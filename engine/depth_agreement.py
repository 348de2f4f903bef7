"""Bring the depth maps that a network made of single photos into agreement: with a reconstruction's points, then with
each other. A network's map is right up to a scale and a shift of inverse depth, and drifts smoothly over the picture.
Scale and shift follow from the points (`engine/scene/estimated_depth.py`). Then a smooth factor for each frame (on a
coarse grid) and the remaining error of its shift are chosen so that the points, and the frames that see the same
surface, agree best. Depth that still contradicts other frames, or lies on a blurred jump, is removed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .job.progress import Progress, unwatched
from .posed.frames import Camera, size_within
from .scene.estimated_depth import DepthFit, fit_depth
from .scene.pixels import resize_nearest, values_at

_GRID = (5, 6)  # rows and columns of a frame's grid of factors
_SAME = (0.3, 0.2, 0.15, 0.1, 0.1)  # a round each: logarithms of depth that differ by more are of other surfaces
_SAMPLES = (18, 24)  # rows and columns of the pixels that are compared between frames
_NEIGHBOURS, _LEAST_SHARED = 6, 0.1  # with how many frames one is compared, and how much of it they must see
_SMALL = 160  # pixels of the longer side of maps while factors are found
_PAIR, _SMOOTH, _STAY = 0.4, 0.2, 0.05  # weights of a pair of pixels, of smoothness and of no change; a point has 1
_ROBUST = 0.03  # residuals beyond it weigh less
_AGREES = 0.04  # the fraction of depth within which two frames agree
_JUMP = 0.05  # the fraction of depth between neighbouring pixels beyond which both lie on a blurred jump
Values = NDArray[np.float64]
Depth = NDArray[np.float32]
"""Planar depth, float32 [H, W] in the scene's unit, 0 = none."""


@dataclass(frozen=True, eq=False)
class Map:
    """A network's depth map: the frame's ``camera``, a function that reads the ``values``, float32 [H, W], and the
    frame's points: their ``places`` [N, 2], x and y as fractions of the picture, and their ``depths`` [N]."""

    camera: Camera
    values: Callable[[], NDArray[np.float32]]
    places: Values
    depths: Values


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A map with its ``fit`` to the points: its depth and camera at a small size, and a ``grid`` [rows, columns] of
    logarithms of factors that correct the depth."""

    map: Map
    fit: DepthFit
    camera: Camera
    depth: Depth
    grid: Values

    def at(self, places: Values) -> Values:
        """Return the logarithm of the corrected depth at ``places`` [N, 2], [N], by the small map; NaN: no depth."""
        depth = values_at(self.depth, places).astype(np.float64)
        index, weight = _corners(places)
        with np.errstate(divide="ignore"):
            return np.where(depth > 0.0, np.log(depth), np.nan) + (self.grid.ravel()[index] * weight).sum(axis=1)

    def terms(self, places: Values) -> tuple[NDArray[np.int64], Values]:
        """Return the unknowns that the logarithm of depth at ``places`` [N, 2] depends on, as indices, and the
        derivatives by them, [N, 5] each. The unknowns are the grid's values, then the shift in median depths."""
        index, weight = _corners(places)
        depth = np.exp(self.at(places)) / self.middle
        slope = -depth if self.fit.is_inverse else 1.0 / depth
        last = np.full((len(index), 1), self.grid.size)
        return np.concatenate([index, last], axis=1), np.concatenate([weight, slope[:, None]], axis=1)

    @property
    def middle(self) -> float:
        """The median of the points' depth."""
        return float(np.median(self.map.depths))

    def changed(self, change: Values) -> _Fitted:
        """Return the same map with ``change`` [rows * columns + 1] added to its unknowns."""
        middle = self.middle
        shift = self.fit.shift + float(change[-1]) * (1.0 / middle if self.fit.is_inverse else middle)
        fit = replace(self.fit, shift=shift)
        small = resize_nearest(self.map.values(), (self.depth.shape[1], self.depth.shape[0]))
        return replace(self, fit=fit, depth=fit.depth(small), grid=self.grid + change[:-1].reshape(_GRID))

    def whole(self) -> Depth:
        """Return the corrected depth at the map's full size, float32 [H, W]."""
        depth = self.fit.depth(self.map.values())
        index, weight = _corners(_places(depth.shape))
        factors = np.exp((self.grid.ravel()[index] * weight).sum(axis=1)).reshape(depth.shape)
        return (depth * factors).astype(np.float32)


def agreeing_depth(maps: Mapping[str, Map], progress: Progress = unwatched) -> Iterator[tuple[str, Depth | None]]:
    """Yield each frame's name in ``maps`` and its agreed depth, or None if the map's values do not grow or fall with
    the points' depth. ``progress`` gets the number of frames done."""
    found: dict[str, _Fitted] = {}
    for name, each in maps.items():
        values = each.values()
        fit = fit_depth(values_at(values, each.places).astype(np.float64), each.depths)
        if fit is not None:
            size = size_within((values.shape[1], values.shape[0]), (_SMALL, _SMALL))
            small = fit.depth(resize_nearest(values, size))
            found[name] = _Fitted(each, fit, each.camera.resized(*size), small, np.zeros(_GRID))
    yield from ((name, None) for name in maps if name not in found)
    if not found:
        return
    names, fitted = [*found], [*found.values()]
    pairs = _neighbours(fitted)
    for done, same in enumerate(_SAME):
        progress(done, len(_SAME) + len(names))
        fitted = _solved(fitted, pairs, same)
    beside = {i: [j for one, j in pairs if one == i] for i in range(len(fitted))}
    for i, name in enumerate(names):
        progress(len(_SAME) + i, len(_SAME) + len(names))
        yield name, _trusted(fitted[i], [fitted[j] for j in beside[i]])


def _places(shape: Sequence[int]) -> Values:
    """Return the centres of the pixels of a picture of this shape (rows, columns), x and y as fractions of its size,
    float64 [rows * columns, 2]."""
    rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]]
    return np.stack([(columns.ravel() + 0.5) / shape[1], (rows.ravel() + 0.5) / shape[0]], axis=-1)


def _corners(places: Values) -> tuple[NDArray[np.int64], Values]:
    """Return the four values of the grid around each place: their indices [N, 4], and their bilinear weights [N, 4]."""
    rows, columns = _GRID
    x, y = (places * [columns - 1, rows - 1]).clip(0, [columns - 1, rows - 1]).T
    left, top = np.minimum(x.astype(np.int64), columns - 2), np.minimum(y.astype(np.int64), rows - 2)
    x, y, first = x - left, y - top, top * columns + left
    index = np.stack([first, first + 1, first + columns, first + columns + 1], axis=-1)
    return index, np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=-1)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Points that two frames see: their places in ``one`` and in the ``other``. ``ratio`` is the logarithm of the
    other's depth over the expected depth, and ``slope`` how the expected depth grows with the depth in ``one``."""

    one: Values
    other: Values
    ratio: Values
    slope: Values


def _seen(one: _Fitted, other: _Fitted, places: Values) -> _Seen:
    """Find which of ``places`` [N, 2] in the frame ``one`` the frame ``other`` sees, and where."""
    depth, lens = np.exp(one.at(places)), one.camera
    x, y = ((places * lens.size) - [lens.cx, lens.cy]).T / np.array([[lens.fx], [lens.fy]])
    local = np.stack([x * depth, y * depth, depth], axis=-1)
    world = local @ lens.camera_to_world[:3, :3].T + lens.centre
    rows, pixels, expected = other.camera.seen(np.nan_to_num(world, nan=np.inf))
    seen_at = pixels / other.camera.size
    beside = float((other.camera.world_to_camera @ [*lens.centre, 1.0])[2])
    ratio = other.at(seen_at) - np.log(np.maximum(expected, 1e-9))
    good = np.isfinite(ratio) & np.isfinite(depth[rows])
    return _Seen(places[rows][good], seen_at[good], ratio[good], 1.0 - beside / expected[good])


def _neighbours(fitted: Sequence[_Fitted]) -> list[tuple[int, int]]:
    """Return pairs (i, j) of frames' indices: each i with those j that see most of the surfaces that i sees."""
    few, pairs = _places((6, 8)), []
    for i, one in enumerate(fitted):
        shares = [(np.abs(_seen(one, other, few).ratio) < _SAME[0]).sum() / len(few) for other in fitted]
        shares[i] = 0.0
        best = sorted(range(len(fitted)), key=lambda j: (-shares[j], j))[:_NEIGHBOURS]
        pairs += [(i, j) for j in best if shares[j] >= _LEAST_SHARED]
    return pairs


def _solved(fitted: Sequence[_Fitted], pairs: Sequence[tuple[int, int]], same: float) -> list[_Fitted]:
    """Do a round of robust least squares. Returns the frames, corrected so that the points and the ``pairs`` of frames
    agree best. A pixel of a pair counts if the logarithms of its depths differ by less than ``same``."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve

    cells, unknowns, places = _GRID[0] * _GRID[1], _GRID[0] * _GRID[1] + 1, _places(_SAMPLES)
    rows, columns = list[NDArray[np.int64]](), list[NDArray[np.int64]]()
    values, targets = list[Values](), list[Values]()
    count = 0

    def add(terms: Sequence[tuple[int, NDArray[np.int64], Values]], target: Values, weight: float) -> None:
        """Add equations: the sum of each term's (frame, cells [N, K], weights [N, K]) is ``target`` [N]."""
        nonlocal count
        robust = weight / np.sqrt(1.0 + (target / _ROBUST) ** 2)
        for frame, index, share in terms:
            rows.append(np.repeat(count + np.arange(len(target)), index.shape[1]))
            columns.append((frame * unknowns + index).ravel())
            values.append((share * robust[:, None]).ravel())
        targets.append(target * robust)
        count += len(target)

    line = np.arange(cells).reshape(_GRID)
    beside = np.concatenate([np.stack([line[:, :-1].ravel(), line[:, 1:].ravel()], -1),
                             np.stack([line[:-1].ravel(), line[1:].ravel()], -1)])  # fmt: skip
    for i, one in enumerate(fitted):
        off = np.log(one.map.depths) - one.at(one.map.places)
        good = np.isfinite(off)
        add([(i, *one.terms(one.map.places[good]))], off[good], 1.0)
        grid = one.grid.ravel()
        plain = np.tile([1.0, -1.0], (len(beside), 1))
        rest = (float(good.sum()) / cells) ** 0.5
        add([(i, beside, plain)], grid[beside[:, 1]] - grid[beside[:, 0]], _SMOOTH * rest)
        add([(i, line.reshape(-1, 1), np.ones((cells, 1)))], -grid, _STAY * rest)
        add([(i, np.full((1, 1), cells), np.ones((1, 1)))], np.zeros(1), _STAY * rest)
    for i, j in pairs:
        seen = _seen(fitted[i], fitted[j], places)
        near = np.abs(seen.ratio) < same
        of_one, one_share = fitted[i].terms(seen.one[near])
        of_other, other_share = fitted[j].terms(seen.other[near])
        terms = [(i, of_one, -one_share * seen.slope[near, None]), (j, of_other, other_share)]
        add(terms, -seen.ratio[near], _PAIR)
    table = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    matrix = coo_matrix(table, shape=(count, unknowns * len(fitted))).tocsr()
    found = np.asarray(spsolve((matrix.T @ matrix).tocsc(), matrix.T @ np.concatenate(targets)))
    return [one.changed(change) for one, change in zip(fitted, found.reshape(len(fitted), -1), strict=True)]


def _trusted(one: _Fitted, beside: Sequence[_Fitted]) -> Depth:
    """Return the full-size depth [H, W] of frame ``one``, 0 on blurred jumps, and 0 where more of the frames ``beside``
    see through the surface than agree with it."""
    depth = one.whole()
    jumps = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        ahead = np.diff(np.log(np.maximum(depth, 1e-9)), axis=axis)
        steep = np.abs(ahead) > _JUMP
        low, high = (slice(None, -1), slice(1, None))
        jumps[(low,) if axis == 0 else (slice(None), low)] |= steep
        jumps[(high,) if axis == 0 else (slice(None), high)] |= steep
    places = _places(one.depth.shape)
    votes = np.zeros(len(places))
    for other in beside:
        seen = _seen(one, other, places)
        at = (seen.one * one.depth.shape[::-1]).astype(np.int64)
        index = at[:, 1] * one.depth.shape[1] + at[:, 0]
        votes[index] += (np.abs(seen.ratio) <= _AGREES).astype(float) - (seen.ratio > 2.0 * _AGREES)
    contradicted = resize_nearest((votes < 0.0).reshape(one.depth.shape), (depth.shape[1], depth.shape[0]))
    return np.where(jumps | contradicted, np.float32(0.0), depth)
