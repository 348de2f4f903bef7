"""Cryptomatte 1.2: several (name, coverage) pairs a pixel, from soft coverage, with the manifest in the
header.

Blender wants 32-bit ranks, an embedded manifest and names without commas or quotes.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..model.rendering import PanopticRendering
from ..scene import VOID, ClassTable
from .deciding import NOTHING

RANKS = 6
"""Pairs a pixel: three layers of channels of two pairs each."""
SMALLEST = 1 / 256
"""Coverage below this is left out: no picture shows it, and noise does not compress."""

Coverage = dict[str, NDArray[np.float32]]
"""Matte name to coverage float32 [H, W] in [0, 1]."""


def class_coverage(rendering: PanopticRendering, classes: ClassTable) -> Coverage:
    """Coverage of each class by its name; the blending weights times the class probabilities."""
    names = matte_names({category.id: category.name for category in classes.categories})
    return {
        names[class_id]: rendering.class_coverage[..., column]
        for column, class_id in enumerate(rendering.class_ids)
        if class_id != VOID and class_id in names
    }


def instance_coverage(rendering: PanopticRendering, classes: ClassTable, instance_names: Mapping[int, str]) -> Coverage:
    """Coverage of each instance by its name.

    Stuff has instance probabilities too (nothing forbids them), so a pixel's instances together get no more
    than its things cover. They fill that up in descending order of their own coverage: at the edge of a chair
    before a wall the chair keeps its share, and the wall's idea of an instance gets nothing.
    """
    things = [column for column, c in enumerate(rendering.class_ids) if c in classes.thing_ids]
    left = rendering.class_coverage[..., things].sum(axis=-1)
    columns = [column for column, i in enumerate(rendering.instance_ids) if i != 0]
    coverage = rendering.instance_coverage[..., columns]
    order = np.argsort(-coverage, axis=-1, kind="stable")
    ranked = np.take_along_axis(coverage, order, axis=-1)
    before = np.cumsum(ranked, axis=-1) - ranked
    filled = np.clip(left[..., None] - before, 0.0, ranked)
    result = np.zeros_like(coverage)
    np.put_along_axis(result, order, filled, axis=-1)
    ids = [rendering.instance_ids[column] for column in columns]
    names = matte_names({i: instance_names.get(i, f"instance {i}") for i in ids})
    return {names[i]: result[..., k] for k, i in enumerate(ids)}


def matte_names(names: Mapping[int, str]) -> dict[int, str]:
    """The names that mattes go by: no commas, quotes or backslashes, and each only once (else the id
    follows).
    """
    clean = {
        key: " ".join("".join(" " if c in ",\"'\\" else c for c in name).split()) or f"id {key}"
        for key, name in names.items()
    }
    seen: dict[str, int] = {}
    for name in clean.values():
        seen[name] = seen.get(name, 0) + 1
    return {key: name if seen[name] == 1 else f"{name} #{key}" for key, name in clean.items()}


def channels(layer: str, coverage: Coverage, alpha: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """The rank channels ``<layer>00.r`` .. ``<layer>02.a``: pairs in descending order of coverage, sum <= 1."""
    shape = alpha.shape
    names = list(coverage)
    stack = np.stack([coverage[name] for name in names], axis=-1) if names else np.zeros((*shape, 0), np.float32)
    stack = np.where((stack >= SMALLEST) & (alpha[..., None] >= NOTHING), stack, 0.0).astype(np.float32)
    total = stack.sum(axis=-1, keepdims=True)
    stack = stack / np.maximum(total, 1.0)
    order = np.argsort(-stack, axis=-1, kind="stable")[..., :RANKS]
    ranked = np.take_along_axis(stack, order, axis=-1)
    floats = np.array([*map(name_float, names)], np.float32)
    result = {}
    for rank in range(RANKS):
        layer_name, pair = f"{layer}{rank // 2:02d}", "rg" if rank % 2 == 0 else "ba"
        present = rank < ranked.shape[-1]
        share = ranked[..., rank] if present else np.zeros(shape, np.float32)
        ids = np.where(share > 0, floats[order[..., rank]], 0) if present else np.zeros(shape)
        result[f"{layer_name}.{pair[0]}"] = np.ascontiguousarray(ids, np.float32)
        result[f"{layer_name}.{pair[1]}"] = np.ascontiguousarray(share, np.float32)
    return result


def header(layer: str, names: list[str]) -> dict[str, str]:
    """The layer's metadata: how names became floats, and which names there are."""
    prefix = f"cryptomatte/{murmur3(layer.encode()):08x}"[:19] + "/"
    manifest = {name: f"{name_bits(name):08x}" for name in names}
    return {
        prefix + "name": layer,
        prefix + "hash": "MurmurHash3_32",
        prefix + "conversion": "uint32_to_float32",
        prefix + "manifest": json.dumps(manifest, ensure_ascii=False, separators=(",", ":")),
    }


def name_float(name: str) -> float:
    """The float that stands for a name in the rank channels."""
    return float(struct.unpack("<f", struct.pack("<I", name_bits(name)))[0])


def name_bits(name: str) -> int:
    """MurmurHash3_32 of the name in UTF-8, with one bit of the exponent flipped where it is no ordinary
    float.
    """
    hashed = murmur3(name.encode())
    return hashed ^ (1 << 23) if (hashed >> 23 & 255) in (0, 255) else hashed


def murmur3(data: bytes, seed: int = 0) -> int:
    """MurmurHash3, x86, 32 bits (the algorithm is in the public domain)."""
    whole = len(data) // 4 * 4
    state = seed
    for start in range(0, whole, 4):
        state ^= _scramble(int.from_bytes(data[start : start + 4], "little"))
        state = (_rotate(state, 13) * 5 + 0xE6546B64) & 0xFFFFFFFF
    if whole < len(data):
        state ^= _scramble(int.from_bytes(data[whole:], "little"))
    state ^= len(data)
    state = (state ^ state >> 16) * 0x85EBCA6B & 0xFFFFFFFF
    state = (state ^ state >> 13) * 0xC2B2AE35 & 0xFFFFFFFF
    return state ^ state >> 16


def _scramble(block: int) -> int:
    return _rotate(block * 0xCC9E2D51 & 0xFFFFFFFF, 15) * 0x1B873593 & 0xFFFFFFFF


def _rotate(value: int, bits: int) -> int:
    return (value << bits | value >> 32 - bits) & 0xFFFFFFFF
