"""What the lifted model shows from one camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene import Camera


class ClipRange(NamedTuple):
    """Planar depths in metres: Gaussians centred nearer than ``near`` or farther than ``far`` are not drawn."""

    near: float = 0.0
    far: float = math.inf


@dataclass(frozen=True, eq=False)
class PanopticRendering:
    """A rendered view, or some rows of one (``camera`` is then that of the rows), before its pixels' labels are
    decided.

    ``image`` float32 [H, W, 3], sRGB-encoded in [0, 1] over black; ``alpha`` float32 [H, W]; ``depth`` float32 [H, W],
    expected planar depth in metres (0 where nothing was hit). ``class_coverage`` float32 [H, W, C] holds
    sum_i w_i * p_i(class) for the blending weights w_i of the pixel's Gaussians: it sums to alpha over the classes.
    ``instance_coverage`` float32 [H, W, S] is the same for instances; the rest of alpha belongs to no object. Column c
    belongs to ``class_ids[c]``, column s to ``instance_ids[s]``.
    """

    camera: Camera
    image: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    class_coverage: NDArray[np.float32]
    instance_coverage: NDArray[np.float32]
    class_ids: tuple[int, ...]
    instance_ids: tuple[int, ...]
