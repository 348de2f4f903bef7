"""The inputs and outputs of the compiled kernels, as named tuples of arrays.

Sizes: N Gaussians, T intersections (pairs of a Gaussian and a tile that it may touch), P pixels, C label channels. The
blending kernels take flat arrays: a picture of P pixels with C channels has shape [P * C]."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..machine.compiled import Array


class Size(NamedTuple):
    """A picture's ``width`` and ``height`` in pixels, and its number of label ``channels``."""

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
    """The arrays of ``Gaussians`` that the projection's backward pass needs again."""

    means: Array
    scales: Array
    quats: Array


class Projected(NamedTuple):
    """The Gaussians projected to the image. ``records`` float32 [N, RECORD]: see `conventions`. ``boxes`` int32 [N, 4]:
    the tiles each may touch, as first column, last column + 1, first row, last row + 1. ``depths`` float32 [N], metres.
    ``means2d`` float32 [N, 2], pixels. ``visible`` bool [N]: where False, the box is empty, ``means2d`` is 0, and
    record and depth are undefined."""

    records: Array
    boxes: Array
    depths: Array
    means2d: Array
    visible: Array


class Intersections(NamedTuple):
    """The list of Gaussians that each tile draws, front to back (gsplat's ``isect_offsets`` and ``flatten_ids``): tile
    t has flatten_ids[isect_offsets[t] : isect_offsets[t + 1]]; int32 [T], int64 [tiles + 1]. ``isect_ids`` int32 [T]
    gives each entry a slot for its gradients. Gaussian i has the slots from gaussian_offsets[i] to before
    gaussian_offsets[i + 1], int64 [N + 1], so that its gradients from all tiles lie together."""

    gaussian_offsets: Array
    isect_offsets: Array
    flatten_ids: Array
    isect_ids: Array


class Splats(NamedTuple):
    """What the forward pass blends: ``records`` [N * RECORD] (see `conventions`) and ``labels`` [N * C], float32."""

    records: Array
    labels: Array


class Blended(NamedTuple):
    """The blended pixels, float32: ``image`` [P * 3], ``labels`` [P * C], ``alpha`` [P], ``depth`` [P], ``final`` [P]
    (the transmittance left) and ``last`` [P] (the index, in the tile's list, of the last Gaussian blended, -1 = none).
    In the backward pass the first four hold gradients instead; ``final`` and ``last`` are those of the forward pass."""

    image: Array
    labels: Array
    alpha: Array
    depth: Array
    final: Array
    last: Array


class TileChannels(NamedTuple):
    """The label channels with a gradient in each tile, usually few. ``counts`` int64 [tiles]: how many. ``channels``
    int32 [tiles * C]: those of tile t, ascending, from t * C on. ``padded``: the largest count, in whole vectors."""

    counts: Array
    channels: Array
    padded: int


class IsectGradients(NamedTuple):
    """The gradients of each intersection, in its slot: ``values`` float32 [T * GRADIENT_WIDTH], and ``labels`` float32
    [T * ``used.padded``]. ``tiles`` int32 [T]: its tile, -1 if nothing was blended; gradients are then undefined."""

    used: TileChannels
    tiles: Array
    values: Array
    labels: Array


class GaussianGradients(NamedTuple):
    """The gradients of ``rasterize``'s tensor arguments, in their order and shapes, and of ``means2d``; float32."""

    means: Array
    scales: Array
    quats: Array
    opacities: Array
    colours: Array
    labels: Array
    means2d: Array


class Scratch(NamedTuple):
    """The workers' working memory. ``next_one`` int64 [1]: the next tile to take, shared. Per worker: ``floats``
    float32 [workers, n], ``members`` int32 [workers, MEMBERS]; ``counts`` int64 [workers, PATCHES] for going back."""

    next_one: Array
    floats: Array
    members: Array
    counts: Array


class Tile(NamedTuple):
    """A tile of the image: its corner pixel ``left``, ``top``, and its ``length`` intersections from ``first`` on."""

    left: int
    top: int
    first: int
    length: int


def flat(array: Array) -> NDArray[np.float32]:
    """Return a one-dimensional view of the array, without copying it."""
    return array.reshape(-1)
