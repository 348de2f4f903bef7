"""preview.json in the lift folder: which camera the watcher wants to see the growing model from.

Whoever watches writes it (by rename), and may replace it at any time; the engine looks at it before each live preview,
and it never changes what is computed. It holds one of

    {"frame": NAME}                                                        a frame of the scene
    {"camera_to_world": 4x4, "K": 3x3, "width": W, "height": H}            any pinhole camera

with the engine's conventions: OpenCV axes in the lift's world (metres, z up), pixel centres at +0.5. Without the file a
held-out frame is shown.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..gates import create_plain
from .atomic import PART
from .errors import JobError
from .json_file import Json, read_object

Matrix = tuple[tuple[float, ...], ...]
LARGEST_SIDE = 16384
_RIGID_TOLERANCE = 2e-3
_FIX = "Choose another camera for the preview."


@dataclass(frozen=True)
class PreviewCamera:
    """A pinhole camera: ``camera_to_world`` rigid 4x4, ``K`` 3x3 without skew, for a picture of that size in pixels."""

    camera_to_world: Matrix
    K: Matrix
    width: int
    height: int

    @property
    def fingerprint(self) -> str:
        """Tells which camera a picture was asked for: the same for a camera that was written and read again."""
        numbers = ([*map(list, self.camera_to_world)], [*map(list, self.K)], self.width, self.height)
        return hashlib.sha256(json.dumps(numbers).encode()).hexdigest()[:16]


PreviewRequest = str | PreviewCamera
"""The name of a frame, or a camera."""


def write_preview_request(path: Path, wanted: PreviewRequest) -> None:
    """Replace preview.json. Takes no time to speak of: nothing is lost with it in a power cut. Raises OSError."""
    if isinstance(wanted, str):
        content: dict[str, object] = {"frame": wanted}
    else:
        content = {
            "camera_to_world": [[float(value) for value in row] for row in wanted.camera_to_world],
            "K": [[float(value) for value in row] for row in wanted.K],
            "width": int(wanted.width),
            "height": int(wanted.height),
        }
    part = path.with_name(f"{PART}{os.getpid()}-{path.name}")  # two Blenders may watch one lift
    with create_plain(part) as file:
        file.write((json.dumps(content) + "\n").encode())
    os.replace(part, path)


def read_preview_request(path: Path) -> PreviewRequest | None:
    """What preview.json asks for; None when there is none. Raises JobError when it is no camera."""
    if not path.exists():
        return None
    content = read_object(path, _FIX)
    frame = content.get("frame")
    if isinstance(frame, str):
        return frame
    try:
        return camera_from(content)
    except (KeyError, ValueError, OverflowError) as error:
        raise JobError(f"is no camera ({error})", path, _FIX) from error


def camera_from(content: Mapping[str, Json]) -> PreviewCamera:
    """From the keys that the module's docstring tells. Raises KeyError, ValueError or OverflowError when something is
    missing, or cannot be drawn."""
    pose, lens = _matrix(content["camera_to_world"], 4), _matrix(content["K"], 3)
    width, height = _side(content["width"]), _side(content["height"])
    rows = [row[:3] for row in pose[:3]]
    for i, one in enumerate(rows):
        for j, other in enumerate(rows):
            if abs(sum(a * b for a, b in zip(one, other, strict=True)) - (i == j)) > _RIGID_TOLERANCE:
                raise ValueError("camera_to_world is not rigid")
    if pose[3] != (0.0, 0.0, 0.0, 1.0) or lens[2] != (0.0, 0.0, 1.0):
        raise ValueError("the last row is not that of a camera")
    if lens[0][0] <= 0 or lens[1][1] <= 0 or lens[0][1] or lens[1][0]:
        raise ValueError("K has no focal length, or skew")
    return PreviewCamera(pose, lens, width, height)


def _matrix(value: Json, size: int) -> Matrix:
    if not isinstance(value, list) or len(value) != size:
        raise ValueError(f"a matrix does not have {size} rows")
    return tuple(_row(row, size) for row in value)


def _row(value: Json, size: int) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != size:
        raise ValueError(f"a row does not have {size} numbers")
    return tuple(_number(each) for each in value)


def _number(value: Json) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{value!r} is no number")
    return float(value)


def _side(value: Json) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= LARGEST_SIDE:
        raise ValueError(f"{value!r} is no number of pixels from 1 to {LARGEST_SIDE}")
    return value
