"""Chunks of Gaussians. A worker that is done with one takes the next.

With equal shares the slowest worker, or one that wakes late, would hold up all others.
"""

from __future__ import annotations

from typing import Any

from ..machine.compiled import Array, device_function
from ..machine.intrinsics import fetch_add

CHUNK = 256
"""Gaussians of a chunk, about. With fewer, taking chunks would cost more."""
MOST_CHUNKS = 256
"""At most this many chunks: some for each of many workers."""


@device_function
def chunk_count(count: int) -> int:
    """How many chunks ``count`` Gaussians make. It is at least one."""
    return max(1, min(MOST_CHUNKS, (count + CHUNK - 1) // CHUNK))


@device_function
def chunk_range(chunk: int, chunks: int, count: int) -> Any:
    """The first of ``count`` Gaussians that belongs to a chunk, and the first of the next one."""
    return count * chunk // chunks, count * (chunk + 1) // chunks


@device_function
def next_chunk(next_one: Array, chunks: int, count: int) -> Any:
    """``chunk_range`` of the next chunk, which is then taken. The range is empty when all have been taken."""
    first, end = chunk_range(fetch_add(next_one), chunks, count)
    return first, min(end, count)
