"""Gaussians are dealt out in chunks: a worker that is done with one takes the next. With equal shares, the slowest
worker, or one that wakes late, would hold up all others."""

from __future__ import annotations

from typing import Any

from ..machine.atomics import fetch_add
from ..machine.compiled import Array, device_function

CHUNK = 256
"""Gaussians, about: fewer would leave too many blocks of lanes half empty, of which each chunk begins new ones."""
MOST_CHUNKS = 256
"""Some for each of many workers; who lists the visible of a chunk adds up the counts of all before it."""


@device_function
def chunk_count(count: int) -> int:
    """How many chunks so many Gaussians make: one at least."""
    return max(1, min(MOST_CHUNKS, (count + CHUNK - 1) // CHUNK))


@device_function
def chunk_range(chunk: int, chunks: int, count: int) -> Any:
    """The first of ``count`` Gaussians that belongs to a chunk, and the first of the next one."""
    return count * chunk // chunks, count * (chunk + 1) // chunks


@device_function
def next_chunk(next_one: Array, chunks: int, count: int) -> Any:
    """As ``chunk_range`` for the chunk whose turn it is; an empty range when all have been taken."""
    first, end = chunk_range(fetch_add(next_one), chunks, count)
    return first, min(end, count)
