"""The meshes of objects and of stuff, cut out of a lift's surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Part:
    """The mesh of one instance, or of one stuff class (``instance_id`` 0), under a ``name`` that no other part has.

    ``xyz`` float32 [V, 3] metres, z up; ``normal`` float32 [V, 3]; ``rgb`` uint8 [V, 3]; ``triangles`` int64 [T, 3].
    """

    name: str
    class_name: str
    class_id: int
    instance_id: int
    xyz: NDArray[np.float32]
    normal: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    triangles: NDArray[np.int64]
