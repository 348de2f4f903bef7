"""Cameras to bake a lift from, which need not be any frame's: a JSON file, a list of

    {"name": NAME, "width": W, "height": H, "K": 3x3, "camera_to_world": 4x4, "clip": [NEAR, FAR]}

with the engine's conventions: OpenCV axes (x right, y down, z forward) in the lift's world (metres, z up), pixels with
their centres at +0.5. In place of "K" there may be "fx", "fy", "cx", "cy", in pixels. "clip" may be left out: planar
depths in metres; what is centred nearer or farther is not drawn. "name" is the name of the file that is written.
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

from .atomic import PART
from .errors import JobError
from .json_file import Json, read_value
from .preview_request import PreviewCamera, camera_from

LONGEST_NAME = 100
_FORBIDDEN = re.compile(r'[<>:"/\\|?*\x00-\x1f]')
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names that are no files on Windows."""
_KEYS = {"name", "width", "height", "K", "fx", "fy", "cx", "cy", "camera_to_world", "clip"}
_FIX = "Correct the file; `python -m engine bake --help` tells what it holds."


@dataclass(frozen=True)
class BakeCamera:
    """A camera to bake from: ``name`` of the file, ``pinhole``, and the planar depths in metres that are drawn."""

    name: str
    pinhole: PreviewCamera
    near: float = 0.0
    far: float = math.inf

    @property
    def fingerprint(self) -> str:
        """The same for a camera that shows the same."""
        return hashlib.sha256(f"{self.pinhole.fingerprint} {self.near!r} {self.far!r}".encode()).hexdigest()[:16]


def read_cameras(path: Path) -> tuple[BakeCamera, ...]:
    """The cameras of a file, in its order. Raises JobError, with the number of the camera, for what is none."""
    listed = read_value(path, _FIX)
    if not isinstance(listed, list) or not listed:
        raise JobError("holds no list of cameras", path, _FIX)
    cameras = []
    for number, each in enumerate(listed, start=1):
        try:
            cameras.append(_camera(each))
        except KeyError as error:
            raise JobError(f"camera {number} has no {error.args[0]!r}", path, _FIX) from error
        except (ValueError, OverflowError) as error:
            raise JobError(f"camera {number}: {error}", path, _FIX) from error
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
    """Raise JobError for a name that comes twice, or is a frame's; capitals make no difference, as on Windows."""
    frames = {name.casefold() for name in taken}
    seen: set[str] = set()
    for name in names:
        if name.casefold() in frames:
            fix = "Give the camera another name, or bake the frame with --frames."
            raise JobError(f"a frame of the scene is named {name!r}", path, fix)
        if name.casefold() in seen:
            raise JobError(f"two cameras are named {name!r}", path, "Give every camera a name of its own.")
        seen.add(name.casefold())


def _entry(camera: BakeCamera) -> dict[str, object]:
    pinhole = camera.pinhole
    clip = {} if math.isinf(camera.far) else {"clip": [camera.near, camera.far]}
    return {
        "name": camera.name,
        "width": pinhole.width,
        "height": pinhole.height,
        "K": pinhole.K,
        "camera_to_world": pinhole.camera_to_world,
        **clip,
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
