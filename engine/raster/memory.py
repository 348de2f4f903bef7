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
"""A block that was not used for so many requests is given back to the system."""


class _Block:
    def __init__(self, size: int) -> None:
        self.bytes = np.empty(size + ALIGNMENT, np.uint8)
        self.used = 0

    def is_free(self) -> bool:
        return sys.getrefcount(self.bytes) == _UNSHARED


def _count_of_unshared() -> int:
    """What ``is_free`` sees when nobody else holds the block; differs between versions of Python."""
    block = object.__new__(_Block)
    block.bytes = np.empty(1, np.uint8)

    def count(self: _Block) -> int:
        return sys.getrefcount(self.bytes)

    return count(block)


_UNSHARED = _count_of_unshared()
_blocks: list[_Block] = []
_calls = 0
_lock = threading.Lock()


def empty(shape: int | tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """As ``np.empty``, aligned to a cache line, out of blocks that are used again."""
    global _calls
    kind = np.dtype(dtype)
    count = math.prod(shape) if isinstance(shape, tuple) else shape
    size = count * kind.itemsize
    with _lock:
        _calls += 1
        fitting = [b for b in _blocks if size + ALIGNMENT <= b.bytes.size <= 2 * size + 65536 and b.is_free()]
        if fitting:
            block = min(fitting, key=lambda b: b.bytes.size)
        else:
            _blocks[:] = [b for b in _blocks if not b.is_free() or b.used > _calls - KEPT_CALLS]
            block = _Block(_rounded(size))
            _blocks.append(block)
        block.used = _calls
        start = -block.bytes.ctypes.data % ALIGNMENT
        view = block.bytes[start : start + size]
    return view.view(kind).reshape(shape)


def empty_tensor(shape: tuple[int, ...]) -> Tensor:
    """As ``torch.empty`` in float32, out of the same blocks."""
    return torch.from_numpy(empty(shape, np.float32))


def _rounded(size: int) -> int:
    """A little more than asked for, so that a slowly growing scene finds its blocks again."""
    step = 1 << max(12, size.bit_length() - 4)
    return -(-size // step) * step


def held_bytes() -> int:
    """All that is held, free or not."""
    return sum(block.bytes.size for block in _blocks)
