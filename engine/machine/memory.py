"""Arrays that are used again: a step as large as the last one allocates nothing.

An array is free again when nobody refers to it any more, which Python's reference count tells; a tensor made
from it counts, so what a caller keeps is never overwritten.
"""

from __future__ import annotations

import math
import sys
import threading
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

ALIGNMENT = 64
KEPT_CALLS = 400
"""A block that was not used for so many requests is given back to the system when a new one is made."""


class _Block:
    def __init__(self, size: int) -> None:
        self.bytes = np.empty(size + ALIGNMENT, np.uint8)
        self.start = -self.bytes.ctypes.data % ALIGNMENT
        self.used = 0

    def is_free(self) -> bool:
        return sys.getrefcount(self.bytes) == _UNSHARED


def _count_of_unshared() -> int:
    """What ``is_free`` sees when nobody else holds the block; differs between versions of Python."""

    def count(self: _Block) -> int:
        return sys.getrefcount(self.bytes)

    return count(_Block(1))


_UNSHARED = _count_of_unshared()
_blocks: dict[int, list[_Block]] = {}
"""By size."""
_calls = 0
_lock = threading.Lock()


def empty(shape: int | tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """As ``np.empty``, aligned to a cache line, out of blocks that are used again."""
    global _calls
    kind = np.dtype(dtype)
    size = kind.itemsize * (math.prod(shape) if isinstance(shape, tuple) else shape)
    with _lock:
        _calls += 1
        block = _free_block(_rounded(size))
        block.used = _calls
        return np.ndarray(shape, kind, block.bytes, block.start)


def _free_block(size: int) -> _Block:
    """One of this size that nobody holds; a new one where there is none, and then those go that were long unused."""
    for block in _blocks.setdefault(size, []):
        if block.is_free():
            return block
    for blocks in _blocks.values():
        blocks[:] = [block for block in blocks if not block.is_free() or block.used > _calls - KEPT_CALLS]
    block = _Block(size)
    _blocks[size].append(block)
    return block


def empty_tensor(shape: tuple[int, ...]) -> Tensor:
    """As ``torch.empty`` in float32, out of the same blocks."""
    return torch.from_numpy(empty(shape, np.float32))


def _rounded(size: int) -> int:
    """A little more than asked for, so that a slowly growing scene finds its blocks again."""
    step = 1 << max(12, size.bit_length() - 4)
    return -(-size // step) * step


def held_bytes() -> int:
    """All that is held, free or not."""
    return sum(block.bytes.size for blocks in _blocks.values() for block in blocks)
