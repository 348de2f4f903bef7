"""Chunks of Gaussians. A worker that has finished one takes the next.

With equal shares, the slowest worker, or one that wakes late, would hold up all others.
"""

from __future__ import annotations

from typing import Any

from ..machine.compiled import Array, device_function
from ..machine.intrinsics import fetch_add

CHUNK = 256
"""The approximate number of Gaussians in a chunk. With fewer, taking chunks would cost more."""
MOST_CHUNKS = 256
"""There are at most this many chunks: several for each of many workers."""


@device_function
def chunk_count(count: int) -> int:
    """The number of chunks of ``count`` Gaussians, which is at least one."""
    return max(1, min(MOST_CHUNKS, (count + CHUNK - 1) // CHUNK))


@device_function
def chunk_range(chunk: int, chunks: int, count: int) -> Any:
    """The first of ``count`` Gaussians that belongs to a chunk, and the first of the next chunk."""
    return count * chunk // chunks, count * (chunk + 1) // chunks


@device_function
def next_chunk(next_one: Array, chunks: int, count: int) -> Any:
    """Take the next chunk, and return its ``chunk_range``. The range is empty if all have been taken."""
    first, end = chunk_range(fetch_add(next_one), chunks, count)
    return first, min(end, count)
