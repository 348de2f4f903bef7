"""Blocks of memory that are reused."""

import os
import signal

import numpy as np
import pytest
import torch

from engine.machine import memory


def held_bytes() -> int:
    """All of it, in use or not."""
    with memory._lock:  # other threads make and drop blocks
        return sum(block.bytes.size for block in memory._blocks)


def test_a_released_block_of_memory_is_reused() -> None:
    first = memory.empty((7, 11), np.float64)
    address = first.ctypes.data
    part = first[2:]
    del first
    assert memory.empty((7, 11), np.float64).ctypes.data != address, "a part of it is still held"
    del part
    assert address in {memory.empty((7, 11), np.float64).ctypes.data for _ in range(2)}


def test_a_larger_memory_block_replaces_one_that_is_too_small() -> None:
    memory._blocks.clear()
    for size in range(10, 25):
        assert memory.empty(size << 20, np.uint8).size == size << 20
        assert held_bytes() < (size + 3) << 20


def test_memory_of_a_living_tensor_is_not_reused() -> None:
    tensor = torch.from_numpy(memory.empty((5, 13), np.float32))
    tensor.fill_(1.0)
    others = [torch.from_numpy(memory.empty((5, 13), np.float32)) for _ in range(3)]
    assert tensor.data_ptr() not in {other.data_ptr() for other in others}
    assert tensor.shape == (5, 13) and tensor.data_ptr() % memory.ALIGNMENT == 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_can_allocate_while_another_thread_held_the_lock() -> None:
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
