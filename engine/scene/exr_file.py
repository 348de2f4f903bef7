"""Channels of OpenEXR files, through OpenEXR."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..posed.exr_header import ExrHeader

_FIX = "Write this file again."


def read_channels(path: Path, header: ExrHeader, names: list[str]) -> list[NDArray[np.float32]]:
    """Channels as float32 [H, W] of the whole picture, 0 beyond the stored pixels. Raises PlgsError."""
    try:
        import OpenEXR
    except ImportError as error:
        fix = "Install it with the engine's Python: python -m pip install -r requirements/engine.txt."
        raise PlgsError("EXR files need the package OpenEXR", path, fix) from error
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            stored: dict[str, NDArray[Any]] = {name: channel.pixels for name, channel in file.channels().items()}
        return [placed(stored[name], header) if name in stored else _missing(name, path) for name in names]
    except (RuntimeError, ValueError, OSError) as error:
        raise PlgsError("the OpenEXR file cannot be read, or is cut off", path, _FIX) from error
    except MemoryError as error:
        raise PlgsError("no memory is left for the OpenEXR file", path, "Close other programs.") from error


def placed(pixels: NDArray[Any], header: ExrHeader) -> NDArray[np.float32]:
    """The stored pixels within the whole picture, float32 [H, W]. 32-bit floats stay bit for bit."""
    values = pixels.astype(np.float32)
    if header.first == (0, 0) and values.shape == header.size[::-1]:
        return values
    whole = np.zeros(header.size[::-1], np.float32)
    x, y = header.first
    left, right = max(x, 0), min(x + values.shape[1], header.size[0])
    top, bottom = max(y, 0), min(y + values.shape[0], header.size[1])
    if left < right and top < bottom:
        whole[top:bottom, left:right] = values[top - y : bottom - y, left - x : right - x]
    return whole


def _missing(name: str, path: Path) -> NDArray[np.float32]:
    raise PlgsError(f'the channel "{name}" is missing'[:90], path, _FIX)
