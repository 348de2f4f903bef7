"""The arrays and instances of a result: semantic_points.npz, anchors.npz, instances.json. Same input, same
bytes.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import write_atomically
from ..scene import ClassTable

FORMAT = 1


@dataclass(frozen=True)
class SegmentLink:
    """A mask's segment that was matched to an instance: its own class and score, its ``pixels`` with depth at the
    size of the lift, and where it lies in the picture (``share`` of the pixels; ``rectangle`` left, top, right,
    bottom, 0..1). Why it was matched: ``cost`` of Algorithm 1, -1.5 (same box) to 0, None for the segment that
    founded the instance; or ``agreement``, the share of the views' judgements that put it together with the
    instance's other masks. The way that was not gone has None.
    """

    frame: str
    segment_id: int
    class_id: int
    score: float
    cost: float | None
    agreement: float | None
    pixels: int
    share: float
    rectangle: tuple[float, float, float, float]


@dataclass(frozen=True)
class InstanceRecord:
    """One object: ``centre`` and ``size`` of its box in world metres, ``yaw`` in radians about +z,
    ``rotation`` the same as a quaternion wxyz, ``colour`` sRGB bytes, ``score`` in [0, 1], ``points`` the
    number of points it owns.
    """

    id: int
    name: str
    class_id: int
    class_name: str
    colour: tuple[int, int, int]
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float
    rotation: tuple[float, float, float, float]
    views: int
    score: float
    points: int
    segments: tuple[SegmentLink, ...]


def write_semantic_points(
    path: Path,
    *,
    xyz: NDArray[np.floating],
    rgb: NDArray[np.uint8],
    class_id: NDArray[np.integer],
    instance_id: NDArray[np.integer],
    confidence: NDArray[np.floating],
) -> None:
    """xyz [N, 3] world metres, rgb uint8 [N, 3], class_id [N] (0 = unknown), instance_id [N] (0 = none),
    confidence [N], the winner's share of the votes. Raises ValueError when lengths differ, OSError.
    """
    _write_arrays(
        path,
        xyz=xyz.astype(np.float32),
        rgb=rgb.astype(np.uint8),
        class_id=class_id.astype(np.int32),
        instance_id=instance_id.astype(np.int32),
        confidence=confidence.astype(np.float32),
    )


def write_anchors(
    path: Path,
    *,
    xyz: NDArray[np.floating],
    class_id: NDArray[np.integer],
    instance_id: NDArray[np.integer],
    opacity: NDArray[np.floating],
    level: NDArray[np.integer],
    rgb: NDArray[np.uint8],
) -> None:
    """xyz [M, 3] world metres, class_id, instance_id [M], opacity [M] (mean of max(opacity, 0) over the
    anchor's Gaussians), level [M] (0 initial, 1.. grown), rgb uint8 [M, 3]. Raises ValueError when lengths
    differ, OSError.
    """
    _write_arrays(
        path,
        xyz=xyz.astype(np.float32),
        class_id=class_id.astype(np.int32),
        instance_id=instance_id.astype(np.int32),
        opacity=opacity.astype(np.float32),
        level=level.astype(np.int32),
        rgb=rgb.astype(np.uint8),
    )


def write_instances(path: Path, classes: ClassTable, instances: Sequence[InstanceRecord]) -> None:
    """instances.json, instances in ascending order of id. Raises ValueError for NaN or a repeated id,
    OSError.
    """
    ids = [instance.id for instance in instances]
    if len(set(ids)) != len(ids) or min(ids, default=1) < 1:
        raise ValueError("instance ids must be unique and at least 1")
    content = {
        "format": FORMAT,
        "up": "z",
        "classes": [asdict(category) for category in classes.categories],
        "instances": [asdict(instance) for instance in sorted(instances, key=lambda instance: instance.id)],
    }
    write_atomically(path, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _write_arrays(path: Path, **arrays: NDArray[np.generic]) -> None:
    """An .npz with fixed time stamps, so that the bytes depend on the arrays only."""
    if len({len(array) for array in arrays.values()}) != 1:
        lengths = ", ".join(f"{name} {len(array)}" for name, array in arrays.items())
        raise ValueError(f"arrays differ in length: {lengths}")
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")  # dated 1980-01-01
            entry.compress_type = zipfile.ZIP_DEFLATED
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(entry, buffer.getvalue())
    write_atomically(path, content.getvalue())
