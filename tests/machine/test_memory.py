"""Blocks of memory that are reused."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest
import torch

from engine.machine import memory
from tests.machine.held_bytes import held_bytes


def test_blocks_are_aligned_and_distinct() -> None:
    arrays = [memory.empty((3, 5), np.float32) for _ in range(4)]
    assert all(array.ctypes.data % 64 == 0 for array in arrays)
    assert len({array.ctypes.data for array in arrays}) == 4


def test_released_block_is_reused() -> None:
    first = memory.empty((7, 11), np.float64)
    address = first.ctypes.data
    part = first[2:]
    del first
    assert memory.empty((7, 11), np.float64).ctypes.data != address, "a part of it is still held"
    del part
    assert address in {memory.empty((7, 11), np.float64).ctypes.data for _ in range(2)}


def test_several_arrays_share_one_block() -> None:
    wanted = (((3, 5), np.float32), (7, np.bool_), (0, np.int64), ((2, 2), np.float64))
    arrays = memory.several(*wanted)
    assert [(array.shape, array.dtype) for array in arrays] == [
        (shape if isinstance(shape, tuple) else (shape,), np.dtype(dtype)) for shape, dtype in wanted
    ]
    assert all(array.ctypes.data % memory.ALIGNMENT == 0 for array in arrays)
    for number, array in enumerate(arrays):
        array[...] = number
    assert [np.unique(array).tolist() for array in arrays] == [[0.0], [True], [], [3.0]]


def test_shared_block_is_reused_once_no_array_is_held() -> None:
    memory._blocks.clear()  # other tests' blocks of this size would be given out first
    first, second = memory.several((5000, np.float32), (6000, np.float32))
    address = first.ctypes.data
    del first
    assert memory.several((5000, np.float32), (6000, np.float32))[0].ctypes.data != address, "one of them is still held"
    del second
    assert address in {memory.several((5000, np.float32), (6000, np.float32))[0].ctypes.data for _ in range(2)}


def test_slightly_smaller_requests_reuse_the_same_blocks() -> None:
    memory._blocks.clear()
    size, smaller = 3 << 20, 11 << 18
    address = memory.empty(size, np.uint8).ctypes.data
    held = held_bytes()
    assert memory.empty(smaller, np.uint8).ctypes.data == address and held_bytes() == held


def test_smallest_fitting_free_block_is_reused() -> None:
    memory._blocks.clear()
    small, large = (memory.empty(size << 20, np.uint8) for size in (4, 7))
    addresses = small.ctypes.data, large.ctypes.data
    del small, large
    first, second = (memory.empty(size << 20, np.uint8) for size in (3, 3))
    assert (first.ctypes.data, second.ctypes.data) == addresses
    held = held_bytes()
    assert memory.empty(1 << 20, np.uint8).ctypes.data not in addresses and held_bytes() > held


def test_larger_block_replaces_one_that_is_too_small() -> None:
    memory._blocks.clear()
    for size in range(10, 25):
        assert memory.empty(size << 20, np.uint8).size == size << 20
        assert held_bytes() < (size + 3) << 20


def test_a_tensor_keeps_its_memory() -> None:
    tensor = torch.from_numpy(memory.empty((5, 13), np.float32))
    tensor.fill_(1.0)
    others = [torch.from_numpy(memory.empty((5, 13), np.float32)) for _ in range(3)]
    assert tensor.data_ptr() not in {other.data_ptr() for other in others}
    assert tensor.shape == (5, 13) and tensor.data_ptr() % memory.ALIGNMENT == 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_fork_survives_another_thread_taking_memory() -> None:
    with memory._lock:  # as if another thread held it, and did not follow
        child = os.fork()
        if child == 0:
            try:
                signal.alarm(20)
                memory.empty(10, np.uint8)
                os._exit(0)
            finally:
                os._exit(2)
    assert os.waitpid(child, 0)[1] == 0
