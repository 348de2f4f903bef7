"""Channels of OpenEXR files, through OpenEXR."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..posed.exr_header import ExrHeader
from ..posed.frames import Size

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
            stored = [part.channels for part in file.parts]
            if len(stored) != header.parts:  # the library leaves out a part that it cannot read
                raise ValueError(f"{len(stored)} of {header.parts} parts")
            return [_channel(stored, header, name, path) for name in names]
    except (RuntimeError, ValueError, OSError) as error:
        raise PlgsError("the OpenEXR file cannot be read, or is cut off", path, _FIX) from error
    except MemoryError as error:
        raise PlgsError("no memory is left for the OpenEXR file", path, "Close other programs.") from error


def _channel(stored: Sequence[Mapping[str, Any]], header: ExrHeader, name: str, path: Path) -> NDArray[np.float32]:
    """A channel of the parts that the library read. Raises PlgsError."""
    one = header.channels.get(name)
    if one is None or one.name not in stored[one.part]:
        raise PlgsError(f'the channel "{name}" is missing'[:90], path, _FIX)
    return placed(stored[one.part][one.name].pixels, header.size, one.first)


def placed(pixels: NDArray[Any], size: Size, first: tuple[int, int]) -> NDArray[np.float32]:
    """The stored pixels, which begin at ``first`` (x, y), within the whole picture, float32 [H, W].

    32-bit floats stay bit for bit.
    """
    values = pixels.astype(np.float32)
    if first == (0, 0) and values.shape == size[::-1]:
        return values
    whole = np.zeros(size[::-1], np.float32)
    x, y = first
    left, right = max(x, 0), min(x + values.shape[1], size[0])
    top, bottom = max(y, 0), min(y + values.shape[0], size[1])
    if left < right and top < bottom:
        whole[top:bottom, left:right] = values[top - y : bottom - y, left - x : right - x]
    return whole
