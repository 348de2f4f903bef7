"""Cryptomatte 1.2: several (name, coverage) pairs per pixel, from soft coverage, with the manifest in the header.

Blender needs 32-bit ranks, an embedded manifest and names without commas or quotes. A kernel ranks the largest
coverages of every pixel in one pass."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..machine.compiled import Array, device_function, parallel_kernel
from ..machine.threads import parallel_for, worker_count
from ..posed.names import matte_names, murmur3, name_bits
from ..scene import VOID, ClassTable
from .layers import FAINT, ONE, STEPS, ZERO

RANKS = 6
"""Pairs per pixel: three layers of channels with two pairs each."""
SMALLEST = 1 / 256
"""Coverage below which pairs are left out: no picture shows them, and noise does not compress."""
CHUNK = 4096
"""Pixels that a worker takes at a time."""

_LEAST = np.float32(SMALLEST)


def rank_coverage(
    coverage: NDArray[np.float32],
    columns: Sequence[int],
    ids: NDArray[np.float32],
    alpha: NDArray[np.float32],
    *,
    limit: NDArray[np.float32] | None,
    out: NDArray[np.float32],
    first_row: int = 0,
) -> None:
    """Find the RANKS largest of some columns of a coverage float32 [h, W, C]. They are written as (id, coverage) pairs
    in descending order; ties go to the earlier column.

    ``ids`` float32 [L]: the id of each of the L ``columns``. ``limit`` float32 [h, W] or None: the most that a pixel's
    pairs cover together, given to the largest first. ``out`` float32 [2 RANKS, H, W], contiguous: h rows from
    ``first_row`` are written. Coverages are whole multiples of 1 / STEPS, and their sum is at most 1. (0, 0) follows
    the last pair; pixels where nothing was rendered have no pairs."""
    height, width, count = coverage.shape
    flat = coverage.reshape(height * width, count)
    limits = np.empty(0, np.float32) if limit is None else limit.reshape(-1)
    planes = out.reshape(2 * RANKS, -1)  # contiguous, as the kernel is compiled for one layout
    workers = worker_count()
    best = np.empty((workers, 2, RANKS), np.float32)
    wanted = np.array(columns, np.int64)
    pixels = RankedPixels(flat, alpha.reshape(-1), limits)
    parallel_for(workers, rank_pixels, pixels, wanted, ids, best, planes, first_row * width)


class RankedPixels(NamedTuple):
    """The pixels to rank: ``coverage`` float32 [P, C], ``alpha`` [P], and ``limit`` [P], empty if there is none."""

    coverage: NDArray[np.float32]
    alpha: NDArray[np.float32]
    limit: NDArray[np.float32]


@parallel_kernel
def rank_pixels(
    worker: int, workers: int, pixels: RankedPixels, columns: Array, ids: Array, best: Array, out: Array, first: int
) -> None:
    """Rank every ``workers``-th chunk of the pixels. ``best`` float32 [workers, 2, RANKS] is scratch for ids and
    coverages; ``first`` is the index of the first pixel in ``out``."""
    coverage, alpha, limit = pixels.coverage, pixels.alpha, pixels.limit
    own_ids, own_shares = best[worker, 0], best[worker, 1]
    for start in range(worker * CHUNK, len(alpha), workers * CHUNK):
        for pixel in range(start, min(start + CHUNK, len(alpha))):
            total = largest_first(coverage[pixel], columns, ids, own_ids, own_shares)
            if len(limit):
                total = min(total, limit[pixel])
                fill(own_ids, own_shares, limit[pixel])
            is_shown = alpha[pixel] >= FAINT
            scale, left = STEPS / max(total, ONE), STEPS
            for rank in range(RANKS):
                steps = min(np.rint(own_shares[rank] * scale), left) if is_shown else ZERO  # at most 1, though rounded
                left -= steps
                out[2 * rank, first + pixel] = own_ids[rank] if steps > ZERO else ZERO
                out[2 * rank + 1, first + pixel] = steps / STEPS


@device_function
def largest_first(coverage: Array, columns: Array, ids: Array, own_ids: Array, own_shares: Array) -> np.float32:
    """Insert a pixel's coverages into its ranks (``own_ids``, ``own_shares``), largest first. Returns the sum of all
    that are not negligible. The ``columns`` of ``coverage`` are ranked; ``ids`` are their ids."""
    total, last = ZERO, RANKS - 1
    for rank in range(RANKS):
        own_ids[rank] = own_shares[rank] = ZERO
    for number in range(len(columns)):
        value = coverage[columns[number]]
        if value < _LEAST:
            continue
        total += value
        if value <= own_shares[last]:
            continue
        rank = last
        while rank > 0 and own_shares[rank - 1] < value:
            own_ids[rank], own_shares[rank] = own_ids[rank - 1], own_shares[rank - 1]
            rank -= 1
        own_ids[rank], own_shares[rank] = ids[number], value
    return total


@device_function
def fill(own_ids: Array, own_shares: Array, limit: float) -> None:
    """Cut a pixel's ranks so that their shares sum to at most ``limit``, which is given to the largest first."""
    left = limit
    for rank in range(RANKS):
        value = min(own_shares[rank], left)
        left -= value
        if value < _LEAST:
            own_ids[rank] = value = ZERO
        own_shares[rank] = value


CRYPTO_INSTANCE, CRYPTO_CLASS = "CryptoInstance", "CryptoClass"


@dataclass(frozen=True, eq=False)
class MatteLayer:
    """A Cryptomatte layer: the ``columns`` of the coverage that it shows, and their ``names``, one each."""

    name: str
    columns: tuple[int, ...]
    names: tuple[str, ...]

    @property
    def ids(self) -> NDArray[np.float32]:
        """The float that stands for each name in the rank channels, float32 [L]."""
        return np.array([*map(name_float, self.names)], np.float32)


def class_layer(class_ids: Sequence[int], classes: ClassTable) -> MatteLayer:
    """Return the layer of all classes but void. ``class_ids`` are the ids of ``class_coverage``'s columns."""
    names = matte_names({category.id: category.name for category in classes.categories})
    return _layer(CRYPTO_CLASS, class_ids, {one: name for one, name in names.items() if one != VOID})


def instance_layer(
    instance_ids: Sequence[int],
    instance_names: Mapping[int, str],
    classes: ClassTable,
    instance_classes: Mapping[int, int] | None = None,
) -> MatteLayer:
    """Return the layer of all instances. Instances of stuff are left out if ``instance_classes`` (instance id to class
    id) is given. ``instance_ids`` are the ids of ``instance_coverage``'s columns."""
    kinds, things = instance_classes, classes.thing_ids
    ids = [one for one in instance_ids if one and (kinds is None or kinds.get(one) in things)]
    return _layer(CRYPTO_INSTANCE, instance_ids, matte_names({i: instance_names.get(i, f"instance {i}") for i in ids}))


def _layer(name: str, ids: Sequence[int], names: Mapping[int, str]) -> MatteLayer:
    columns = tuple(column for column, one in enumerate(ids) if one in names)
    return MatteLayer(name, columns, tuple(names[ids[column]] for column in columns))


def channels(layer: str, planes: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """The channels ``<layer>00.r`` .. ``<layer>02.a`` of float32 [2 RANKS, H, W], alternately id and coverage."""
    return {f"{layer}{plane // 4:02d}.{'rgba'[plane % 4]}": planes[plane] for plane in range(2 * RANKS)}


def header(layer: str, names: Sequence[str]) -> dict[str, str]:
    """Return the layer's metadata: how names become floats, and which names there are."""
    prefix = f"cryptomatte/{murmur3(layer.encode()):08x}"[:19] + "/"  # seven digits, as specified
    manifest = {name: f"{name_bits(name):08x}" for name in names}
    return {
        prefix + "name": layer,
        prefix + "hash": "MurmurHash3_32",
        prefix + "conversion": "uint32_to_float32",
        prefix + "manifest": json.dumps(manifest, ensure_ascii=False, separators=(",", ":")),
    }


def name_float(name: str) -> float:
    """Return the float that stands for a name in the rank channels."""
    return float(struct.unpack("<f", struct.pack("<I", name_bits(name)))[0])
