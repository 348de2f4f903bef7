"""How long a reconstruction's length is in metres, by measured depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene.depth import in_metres, read_depth_array
from ..scene.pixels import decode

_LEAST_POINTS = 50
_MOST_SPREAD = 0.2


@dataclass(frozen=True)
class Scale:
    """``metres`` that a length of the reconstruction is, the median over ``points`` places; half of them agree within
    the share ``spread``.
    """

    metres: float
    spread: float
    points: int

    def apply(self, model: Any) -> None:
        """Bring a pycolmap Reconstruction into metres."""
        import pycolmap

        model.transform(pycolmap.Sim3d(self.metres, pycolmap.Rotation3d(), np.zeros((3, 1))))


def metres_per_length(model: Any, depths: Mapping[str, Path]) -> Scale | None:
    """The median of measured depth over a point's depth in the reconstruction, over all photos' points.

    ``depths`` are files by the photos' stems. None where too few points have depth, or their ratios disagree. Raises
    PlgsError for a file that is not a depth map.
    """
    ratios: list[NDArray[np.float64]] = []
    for image in model.images.values():
        path = depths.get(Path(image.name).stem)
        if path is None or not image.has_pose:
            continue
        seen = [point for point in image.points2D if point.has_point3D()]
        if not seen:
            continue
        world = np.array([model.points3D[point.point3D_id].xyz for point in seen])
        pose = image.cam_from_world().matrix()
        z = world @ pose[2, :3] + pose[2, 3]
        depth = _read(path)
        height, width = depth.shape
        size = model.cameras[image.camera_id]
        pixels = np.array([point.xy for point in seen]) * [width / size.width, height / size.height]
        columns, rows = np.floor(pixels).astype(np.int64).T
        measured = depth[rows.clip(0, height - 1), columns.clip(0, width - 1)]
        good = (measured > 0.0) & (z > 0.0)
        ratios.append(measured[good] / z[good])
    return _median(np.concatenate(ratios)) if ratios else None


def _median(ratios: NDArray[np.float64]) -> Scale | None:
    if len(ratios) < _LEAST_POINTS:
        return None
    metres = float(np.median(ratios))
    spread = float(np.median(np.abs(ratios / metres - 1.0)))
    return Scale(metres, spread, len(ratios)) if spread <= _MOST_SPREAD else None


def _read(path: Path) -> NDArray[np.float32]:
    return in_metres(read_depth_array(path) if path.suffix.lower() == ".npy" else decode(path, as_colour=False))
