"""The inputs and outputs of the kernels, as named tuples of arrays.

N Gaussians, T intersections (pairs of a Gaussian and a tile that it may touch), P pixels, C channels of labels. Arrays
of the blending kernels are flat: a picture of P pixels with C channels has shape [P * C].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..machine.compiled import Array


class Size(NamedTuple):
    """A picture's ``width`` and ``height`` in pixels, and the ``channels`` of its labels."""

    width: int
    height: int
    channels: int


class Gaussians(NamedTuple):
    """The arguments of ``rasterize`` as float32 arrays: ``means`` and ``scales`` [N, 3] in metres, ``quats`` [N, 4]
    wxyz, ``opacities`` [N], ``colours`` [N, 3]."""

    means: Array
    scales: Array
    quats: Array
    opacities: Array
    colours: Array


class Shapes(NamedTuple):
    """The parts of ``Gaussians`` that the backward pass of the projection needs."""

    means: Array
    scales: Array
    quats: Array


class Projected(NamedTuple):
    """The projection of each Gaussian: ``records`` float32 [N, RECORD]; ``boxes`` int32 [N, 4], the first and one past
    the last column of tiles, then the same for rows; ``depths`` float32 [N], metres; ``means2d`` float32 [N, 2],
    pixels; ``visible`` bool [N]. A Gaussian that is not visible has an empty box and a ``means2d`` of 0; its record and
    depth are meaningless."""

    records: Array
    boxes: Array
    depths: Array
    means2d: Array
    visible: Array


class Intersections(NamedTuple):
    """The Gaussians that each tile draws, front to back (gsplat's ``isect_offsets`` and ``flatten_ids``), and where
    their gradients in that tile go. ``isect_offsets`` int64 [tiles + 1]: tile t has the Gaussians
    flatten_ids[isect_offsets[t] : isect_offsets[t + 1]], int32 [T]. ``isect_ids`` int32 [T], in the same order: the
    number of the intersection if they are counted Gaussian by Gaussian; Gaussian i has those from gaussian_offsets[i]
    to before gaussian_offsets[i + 1], int64 [N + 1]."""

    gaussian_offsets: Array
    isect_offsets: Array
    flatten_ids: Array
    isect_ids: Array


class Splats(NamedTuple):
    """What is blended: ``records`` [N * RECORD] and ``labels`` [N * C], float32."""

    records: Array
    labels: Array


class Blended(NamedTuple):
    """The blended pixels, float32: ``image`` [P * 3], ``labels`` [P * C], ``alpha``, ``depth`` and the ``final``
    transmittance [P]. ``last`` [P] is the last Gaussian blended, as its index in the tile's list; -1 means none. For
    the backward pass, the gradients of the first four, and ``final`` and ``last`` as the forward pass left them."""

    image: Array
    labels: Array
    alpha: Array
    depth: Array
    final: Array
    last: Array


class TileChannels(NamedTuple):
    """The label channels that have a gradient in each tile: usually few of all. ``counts`` int64 [tiles]; those of tile
    t are ``channels`` int32 [tiles * C] from t * C on, ascending. ``padded``: the largest count, in whole vectors."""

    counts: Array
    channels: Array
    padded: int


class IsectGradients(NamedTuple):
    """The gradients of each intersection, by its number: ``values`` float32 [T * GRADIENT_WIDTH] and ``labels`` [T *
    ``used.padded``]. ``tiles`` int32 [T] is the tile, -1 where nothing was blended: the others are then meaningless."""

    used: TileChannels
    tiles: Array
    values: Array
    labels: Array


class GaussianGradients(NamedTuple):
    """The gradients of ``rasterize``'s arguments, with their order and shapes, and of ``means2d`` [N, 2], float32."""

    means: Array
    scales: Array
    quats: Array
    opacities: Array
    colours: Array
    labels: Array
    means2d: Array


class Scratch(NamedTuple):
    """Working memory. ``next_one`` int64 [1] is the next tile to take. Each worker has ``floats`` float32 [workers,
    n], ``members`` int32 [workers, MEMBERS] and, for the backward pass, ``counts`` int64 [workers, PATCHES]."""

    next_one: Array
    floats: Array
    members: Array
    counts: Array


class Tile(NamedTuple):
    """The pixel ``left``, ``top`` at a tile's corner, and the tile's ``length`` intersections from ``first`` on."""

    left: int
    top: int
    first: int
    length: int


def flat(array: Array) -> NDArray[np.float32]:
    """The array as a view of the same memory in one row."""
    return array.reshape(-1)
