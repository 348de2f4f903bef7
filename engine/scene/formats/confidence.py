"""Depth that a sensor itself does not trust is none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..frame import SceneError, Size
from ..pixels import decode_single_channel, resize_nearest


@dataclass(frozen=True, eq=False)
class ConfidentDepth:
    """Reads depth through ``read`` and drops what the image ``confidence`` shows as 0, the lowest of ARKit's levels."""

    read: Callable[[Size | None], NDArray[np.float32]]
    confidence: Path

    def __call__(self, size: Size | None = None) -> NDArray[np.float32]:
        """Planar depth, float32 [H, W] metres, 0 = none. Raises SceneError."""
        depth, level = self.read(None), decode_single_channel(self.confidence)
        depth = drop_untrusted(depth, level, self.confidence)
        return resize_nearest(depth, size) if size else depth


def drop_untrusted(depth: NDArray[np.float32], level: NDArray[np.integer], path: Path) -> NDArray[np.float32]:
    """``depth`` [H, W] where ``level`` [H, W] is above 0, else 0. Raises SceneError when they differ in size."""
    if depth.shape != level.shape:
        raise SceneError("confidence has another size than depth", path, "Remove the confidence, or copy it again.")
    return np.where(level > 0, depth, np.float32(0.0))
