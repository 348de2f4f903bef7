"""The points of the reconstruction that a scene's poses come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """``xyz`` float64 [N, 3] in the world of the poses, ``rgb`` uint8 [N, 3] sRGB.

    ``seen_by`` are, by frame name, indices int64 [K] of the points that were found in the frame's picture (their
    tracks). It is empty where the format does not tell.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    seen_by: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.xyz)

    def turned(self, turn: NDArray[np.float64]) -> SparsePoints:
        """The same points in the world that the rotation ``turn``, float64 [3, 3], makes."""
        return SparsePoints(self.xyz @ turn.T, self.rgb, self.seen_by)
