"""Colour images that lie in files of their own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .frame import Size
from .pixels import decode, resize_colour


@dataclass(frozen=True)
class ColourReader:
    """Reads one frame's colour image."""

    path: Path

    def __call__(self, size: Size | None = None) -> NDArray[np.uint8]:
        """uint8 [H, W, 3] RGB at ``size`` (width, height) or the image's own. Raises SceneError."""
        pixels = decode(self.path, as_colour=True)
        return resize_colour(pixels, size) if size else pixels
