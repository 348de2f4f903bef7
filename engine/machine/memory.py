"""Arrays whose memory is reused: a step as large as the last one allocates nothing.

An array is free again when nothing refers to it any more, by Python's reference count. A tensor made from it counts, so
what a caller keeps is never overwritten. With fresh memory instead, the forward and backward passes of a room of
640x480 pixels with 46 labels take 16 to 37 % longer.
"""

from __future__ import annotations

import math
import os
import sys
import threading
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

ALIGNMENT = 64
KEPT_CALLS = 150
"""When a new block is made, blocks that were unused for this many requests are returned to the system."""
LEAST_STEP = 4096
"""Bytes, a power of two. All sizes are multiples of it."""


class _Block:
    __slots__ = ("bytes", "start", "used")

    def __init__(self, size: int) -> None:
        self.bytes = np.empty(size + ALIGNMENT, np.uint8)
        self.start = -self.bytes.ctypes.data % ALIGNMENT
        self.used = 0


_unshared = _Block(1)
_REFERENCES = sys.getrefcount(_unshared.bytes)
"""The reference count of a block's bytes when nothing else holds them. It differs between versions of Python."""
_blocks: dict[int, list[_Block]] = {}
"""All blocks, by size in bytes."""
_calls = 0
_lock = threading.Lock()


def _renew_lock() -> None:
    """Called in a forked process: a thread that does not exist there may have held the lock."""
    global _lock
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_lock)


def empty(shape: int | tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Like ``np.empty``, but aligned to a cache line and taken from blocks that are reused."""
    kind = np.dtype(dtype)
    buffer, start = _take(kind.itemsize * (math.prod(shape) if isinstance(shape, tuple) else shape))
    return np.ndarray(shape, kind, buffer, start)


def several(*wanted: tuple[int | tuple[int, ...], DTypeLike]) -> tuple[NDArray[Any], ...]:
    """Arrays of these shapes and dtypes, like those of ``empty``, from one block, which is free again when none of
    them is held any more. This is cheaper than making them one by one."""
    pieces, size = [], 0
    for shape, dtype in wanted:
        kind = np.dtype(dtype)
        pieces.append((shape, kind, size))
        length = math.prod(shape) if isinstance(shape, tuple) else shape
        size += -(-kind.itemsize * length // ALIGNMENT) * ALIGNMENT
    buffer, first = _take(size)
    return tuple([np.ndarray(shape, kind, buffer, first + start) for shape, kind, start in pieces])


def _take(size: int) -> tuple[NDArray[Any], int]:
    """The bytes of a free block, which is made if there is none, and the place of the first aligned byte."""
    global _calls
    size = _rounded(size)
    with _lock:
        _calls += 1
        block = _free_block(size) or _free_block(_rounded(size + 1)) or _new_block(size)
        block.used = _calls
        return block.bytes, block.start  # held from here on, before another thread can look for a free block


def _free_block(size: int) -> _Block | None:
    for block in _blocks.get(size, ()):
        if sys.getrefcount(block.bytes) == _REFERENCES:
            return block
    return None


def _new_block(size: int) -> _Block:
    """Make a new block; those that were unused for long are returned to the system."""
    for blocks in _blocks.values():
        blocks[:] = [
            block for block in blocks if sys.getrefcount(block.bytes) != _REFERENCES or block.used > _calls - KEPT_CALLS
        ]
    block = _Block(size)
    _blocks.setdefault(size, []).append(block)
    return block


def _rounded(size: int) -> int:
    """A little more than requested, so that a slowly growing scene finds its blocks again; a shrinking one finds them
    under the next size."""
    step = max(LEAST_STEP, 1 << max(0, size.bit_length() - 4))
    return -(-size // step) * step
