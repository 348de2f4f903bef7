"""Cameras of two files: those to bake a lift from, and the one that its live preview shows.

Conventions are the engine's: OpenCV axes (x right, y down, z forward) in the lift's world (metres, z up), pixels with
their centres at +0.5. Cameras to bake need not be any frame's. Their file is a JSON list of

    {"name": NAME, "width": W, "height": H, "K": 3x3, "camera_to_world": 4x4, "clip": [NEAR, FAR]}

"fx", "fy", "cx", "cy" (pixels) may stand in place of "K". "clip" may be left out. It holds planar depths in metres:
what is centred nearer or farther is not drawn. "name" is the name of the file that is written.

preview.json in the lift folder says which camera a watcher wants to see the growing model from. The watcher writes it
by rename, at any time; the engine looks at it before each live preview, and it never changes what is computed. It holds
one of

    {"frame": NAME}                                                        a frame of the scene
    {"camera_to_world": 4x4, "K": 3x3, "width": W, "height": H}            any pinhole camera

Without it a held-out frame is shown.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import PlgsError
from ..gates import create_plain
from ..json_file import Json, read_object, read_value
from .atomic import PART

Matrix = tuple[tuple[float, ...], ...]
LARGEST_SIDE = 16384
"""Pixels of a picture's longest side, at most."""
_RIGID_TOLERANCE = 2e-3
LONGEST_NAME = 100
"""Characters of a camera's name, at most."""
_FORBIDDEN = re.compile(r'[<>:"/\\|?*\x00-\x1f]')
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names that are no files on Windows."""
_KEYS = {"name", "width", "height", "K", "fx", "fy", "cx", "cy", "camera_to_world", "clip"}
_FIX = "Correct the file; `python -m engine bake --help` says what it holds."
_PREVIEW_FIX = "Choose another camera for the preview."


@dataclass(frozen=True)
class PreviewCamera:
    """A pinhole camera: ``camera_to_world`` rigid 4x4, ``K`` 3x3 without skew, for a picture of that size in pixels."""

    camera_to_world: Matrix
    K: Matrix
    width: int
    height: int

    @property
    def fingerprint(self) -> str:
        """Names the camera. It is the same for a camera that was written and read again."""
        numbers = ([*map(list, self.camera_to_world)], [*map(list, self.K)], self.width, self.height)
        return hashlib.sha256(json.dumps(numbers).encode()).hexdigest()[:16]


PreviewRequest = str | PreviewCamera
"""The name of a frame, or a camera."""


@dataclass(frozen=True)
class BakeCamera:
    """A camera to bake from: ``name`` of the file, ``pinhole``, and the planar depths in metres that are drawn."""

    name: str
    pinhole: PreviewCamera
    near: float = 0.0
    far: float = math.inf

    @property
    def fingerprint(self) -> str:
        """Names what the camera shows. It is the same for a camera that shows the same."""
        return hashlib.sha256(f"{self.pinhole.fingerprint} {self.near!r} {self.far!r}".encode()).hexdigest()[:16]


def read_cameras(path: Path) -> tuple[BakeCamera, ...]:
    """The cameras of a file, in its order. Raises PlgsError, with the number of the camera, for what is none."""
    listed = read_value(path, _FIX)
    if not isinstance(listed, list) or not listed:
        raise PlgsError("holds no list of cameras", path, _FIX)
    cameras = []
    for number, each in enumerate(listed, start=1):
        try:
            cameras.append(_camera(each))
        except KeyError as error:
            raise PlgsError(f"camera {number} has no {error.args[0]!r}", path, _FIX) from error
        except (ValueError, OverflowError) as error:
            raise PlgsError(f"camera {number}: {error}", path, _FIX) from error
    refuse_equal_names([camera.name for camera in cameras], path)
    return tuple(cameras)


def write_cameras(path: Path, cameras: Sequence[BakeCamera]) -> None:
    """A file that `read_cameras` reads as the very same cameras. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{PART}{os.getpid()}-{path.name}")  # several processes may bake the same shot
    part.write_text(json.dumps([_entry(camera) for camera in cameras], allow_nan=False) + "\n", encoding="utf-8")
    os.replace(part, path)


def safe_name(text: str) -> str:
    """A name that every system takes for a file, as near to ``text`` as can be."""
    name = _FORBIDDEN.sub("_", text).strip(". ")[:LONGEST_NAME].rstrip(". ") or "camera"
    return f"_{name}" if _RESERVED.fullmatch(name) else name


def refuse_equal_names(names: Sequence[str], path: Path, taken: Sequence[str] = ()) -> None:
    """Raise PlgsError for a name that comes twice, or is a frame's; capitals make no difference, as on Windows."""
    frames = {name.casefold() for name in taken}
    seen: set[str] = set()
    for name in names:
        if name.casefold() in frames:
            fix = "Give the camera another name, or bake the frame with --frames."
            raise PlgsError(f"a frame of the scene is named {name!r}", path, fix, option="--frames")
        if name.casefold() in seen:
            raise PlgsError(f"two cameras are named {name!r}", path, "Give every camera a name of its own.")
        seen.add(name.casefold())


def write_preview_request(path: Path, wanted: PreviewRequest) -> None:
    """Replace preview.json. It takes a moment only, since a power cut may lose it. Raises OSError."""
    content = {"frame": wanted} if isinstance(wanted, str) else _pinhole(wanted)
    part = path.with_name(f"{PART}{os.getpid()}-{path.name}")  # two Blenders may watch one lift
    with create_plain(part) as file:
        file.write((json.dumps(content) + "\n").encode())
    os.replace(part, path)


def read_preview_request(path: Path) -> PreviewRequest | None:
    """What preview.json asks for; None when there is none. Raises PlgsError when it is no camera."""
    if not path.exists():
        return None
    content = read_object(path, _PREVIEW_FIX)
    frame = content.get("frame")
    if isinstance(frame, str):
        return frame
    try:
        return camera_from(content)
    except (KeyError, ValueError, OverflowError) as error:
        raise PlgsError(f"is no camera ({error})", path, _PREVIEW_FIX) from error


def camera_from(content: Mapping[str, Json]) -> PreviewCamera:
    """From the keys that the module's docstring names. Raises KeyError, ValueError or OverflowError when something is
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
    rows = [row for row in value if isinstance(row, list) and len(row) == size]
    if len(rows) != size:
        raise ValueError(f"a row does not have {size} numbers")
    return tuple(tuple(map(_number, row)) for row in rows)


def _number(value: Json) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{value!r} is no number")
    return float(value)


def _side(value: Json) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= LARGEST_SIDE:
        raise ValueError(f"{value!r} is no number of pixels from 1 to {LARGEST_SIDE}")
    return value


def _entry(camera: BakeCamera) -> dict[str, object]:
    clip = {} if math.isinf(camera.far) else {"clip": [camera.near, camera.far]}
    return {"name": camera.name, **_pinhole(camera.pinhole), **clip}


def _pinhole(camera: PreviewCamera) -> dict[str, object]:
    return {
        "width": int(camera.width),
        "height": int(camera.height),
        "K": [[float(value) for value in row] for row in camera.K],
        "camera_to_world": [[float(value) for value in row] for row in camera.camera_to_world],
    }


def _camera(value: Json) -> BakeCamera:
    """Raises KeyError, ValueError or OverflowError."""
    if not isinstance(value, dict):
        raise ValueError("is no JSON object")
    unknown = sorted(set(value) - _KEYS)
    if unknown:
        raise ValueError(f"{unknown[0]!r} is not known")
    near, far = _clip(value.get("clip"))
    return BakeCamera(_name(value["name"]), camera_from({**value, "K": _intrinsics(value)}), near, far)


def _intrinsics(value: Mapping[str, Json]) -> Json:
    if "K" in value:
        if {"fx", "fy", "cx", "cy"} & set(value):
            raise ValueError("has K as well as fx, fy, cx, cy")
        return value["K"]
    return [[value["fx"], 0.0, value["cx"]], [0.0, value["fy"], value["cy"]], [0.0, 0.0, 1.0]]


def _name(value: Json) -> str:
    if not isinstance(value, str) or not value or len(value) > LONGEST_NAME:
        raise ValueError(f"the name has to be a text of 1 to {LONGEST_NAME} characters")
    if _FORBIDDEN.search(value) or _RESERVED.fullmatch(value) or value[0] in ". " or value[-1] in ". ":
        raise ValueError(f"{value!r} cannot be the name of a file on every system")
    return value


def _clip(value: Json) -> tuple[float, float]:
    if value is None:
        return 0.0, math.inf
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError("clip has to be [near, far]")
    numbers = [float(each) for each in value if isinstance(each, int | float) and not isinstance(each, bool)]
    if len(numbers) != 2 or not 0 <= numbers[0] < numbers[1]:
        raise ValueError("clip has to be [near, far] in metres, near at least 0 and less than far")
    return numbers[0], numbers[1]
