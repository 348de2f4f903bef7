"""Tensors out of a .safetensors file that may be anybody's."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open

from ..gates import refuse_special


def read_tensors(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """The tensors by name, and the header's notes. Raises ValueError for what is no such file, OSError.

    Their bytes are all there (safetensors sees to that): a file takes no more memory than it is long.
    """
    refuse_special(path)
    try:
        with safe_open(path, "pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(str(error)) from error
