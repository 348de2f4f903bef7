"""Tensors from a .safetensors file of unknown origin."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open

from ..gates import refuse_special
from ..job.system import main_memory

MOST_BYTES = 1 << 35
"""The largest model (see `checking`) is smaller, and so is a checkpoint of it."""


def read_tensors(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """The tensors by name, and the header's notes. Raises ValueError if it is not such a file, or takes more memory
    than there is, and OSError.

    safetensors checks that all their bytes are there, so a file takes no more memory than its length. A sparse file
    may be longer than its space on disk.
    """
    refuse_special(path)
    size, memory = path.stat().st_size, main_memory()
    if size > MOST_BYTES or (memory is not None and size > memory.free):
        raise ValueError(f"it needs {size / 1e9:.1f} GB of memory, which is more than there is")
    try:
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(str(error)) from error
    except (MemoryError, RuntimeError) as error:  # torch's allocator has no error class of its own
        raise ValueError(f"no memory is left for {size / 1e9:.1f} GB") from error
