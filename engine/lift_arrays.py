"""Read a finished lift as arrays, for programs in Python: ``engine.read_lift``. Needs only NumPy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .corrections import read_corrected
from .job import LiftFolder
from .job.manifest import check_sizes
from .json_file import Json, read_object
from .known_scene import known_scene
from .posed import ClassTable, PosedFrame
from .posed.ply import read_gaussians
from .result_files import Anchors, Instance, SemanticPoints

_SH_DEGREE_0 = 0.5 / math.sqrt(math.pi)


@dataclass(frozen=True, eq=False)
class Gaussians:
    """The Gaussians: ``xyz`` float32 [G, 3] world metres, ``scale`` float32 [G, 3] standard deviations in metres along
    the axes of ``rotation``, float32 [G, 4] unit quaternions wxyz, ``opacity`` float32 [G] in [0, 1], ``rgb`` float32
    [G, 3] sRGB in [0, 1], ``class_id`` int32 [G] (0 = unknown), ``instance_id`` int32 [G] (0 = none)."""

    xyz: NDArray[np.float32]
    scale: NDArray[np.float32]
    rotation: NDArray[np.float32]
    opacity: NDArray[np.float32]
    rgb: NDArray[np.float32]
    class_id: NDArray[np.int32]
    instance_id: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class LiftArrays:
    """What a lift found, after people's corrections, in its world (metres, z up): objects (``instances``), labelled
    ``points``, the model's ``anchors`` and ``gaussians``, and the scene's ``frames`` with cameras (OpenCV's axes, pixel
    centres at +0.5). ``metrics`` is metrics.json, of the uncorrected lift."""

    classes: ClassTable
    instances: tuple[Instance, ...]
    points: SemanticPoints
    anchors: Anchors
    gaussians: Gaussians
    frames: tuple[PosedFrame, ...]
    metrics: Mapping[str, Json]


def read_lift(folder: str | Path) -> LiftArrays:
    """Read the result of a finished lift, without its pictures. Raises PlgsError if it is not finished or damaged."""
    lift = LiftFolder.open(Path(folder))
    check_sizes(lift.result_path)
    corrected = read_corrected(lift.path)
    rows = corrected.splats(read_gaussians(lift.result_path / "gaussians.ply"))

    def columns(names: str) -> NDArray[np.float32]:
        return np.stack([rows[name] for name in names.split()], axis=1)

    xyz, turns = columns("x y z"), columns("rot_0 rot_1 rot_2 rot_3")
    gaussians = Gaussians(
        xyz,
        np.exp(columns("scale_0 scale_1 scale_2")),
        turns / np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), np.float32(1e-12)),
        1 / (1 + np.exp(-rows["opacity"])),
        np.clip(0.5 + np.float32(_SH_DEGREE_0) * columns("f_dc_0 f_dc_1 f_dc_2"), 0, 1),
        rows["class_id"].astype(np.int32),
        rows["instance_id"].astype(np.int32),
    )
    return LiftArrays(
        corrected.classes,
        corrected.instances,
        corrected.points,
        corrected.anchors(),
        gaussians,
        known_scene(lift).frames,
        read_object(lift.result_path / "metrics.json", "Resume the lift."),
    )
