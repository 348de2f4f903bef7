"""Label maps brought to another size without inventing labels."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Kind = TypeVar("Kind", bound=np.generic)


def nearest(values: NDArray[Kind], size: tuple[int, int]) -> NDArray[Kind]:
    """[H, W, ...] to ``size`` (width, height): each new pixel takes the old one that holds its centre."""
    (height, width), (new_width, new_height) = values.shape[:2], size
    rows = ((np.arange(new_height) + 0.5) * height / new_height).astype(np.int64)
    columns = ((np.arange(new_width) + 0.5) * width / new_width).astype(np.int64)
    return values[rows[:, None], columns[None, :]]
