"""How the pixels of a picture are dealt out to threads: in chunks that depend on their number alone, so that sums over
chunks have the same bits however many threads there are."""

from __future__ import annotations

from typing import Any

from ..machine.compiled import compiled

CHUNK = 8192
"""Pixels of one chunk."""


@compiled
def chunk_count(pixels: int) -> int:
    """Of a picture of so many pixels."""
    return -(-pixels // CHUNK)


@compiled
def chunk_range(chunk: int, pixels: int) -> Any:
    """First pixel of a chunk, and the one behind its last."""
    return chunk * CHUNK, min((chunk + 1) * CHUNK, pixels)
