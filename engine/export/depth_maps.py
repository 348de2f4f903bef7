"""The depth of a lifted scene, a map a frame: what ``lift --depth`` takes where there is no sensor."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..job import write_atomically
from ..passes import PanopticLayers
from ..scene import Frame

LEAST_COVERAGE = 0.5
"""Where less of a pixel is covered nothing is known of its depth."""


def write_depth_maps(output: Path, views: Iterable[tuple[Frame, PanopticLayers]]) -> None:
    """<frame>.npy: planar depth float32 [H, W] in metres, 0 = none. Raises OSError."""
    for frame, layers in views:
        out = io.BytesIO()
        depth = np.where(layers.combined[..., 3] >= LEAST_COVERAGE, layers.depth, np.float32(0))
        np.save(out, depth.astype(np.float32), allow_pickle=False)
        write_atomically(output / f"{frame.name}.npy", out.getvalue())
