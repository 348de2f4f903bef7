"""Two files of cameras: those from which a lift is baked, and the one that its live preview shows.

Conventions are the engine's: OpenCV axes (x right, y down, z forward) in the lift's world (metres, z up), pixels with
their centres at +0.5. Cameras to bake need not belong to a frame. Their file is a JSON list of

    {"name": NAME, "width": W, "height": H, "K": 3x3, "camera_to_world": 4x4, "clip": [NEAR, FAR],
     "projection": KIND, "frame": NUMBER, "fps": RATE, "display": [LEFT, TOP, WIDTH, HEIGHT], "previous": CAMERA,
     "next": CAMERA}

"fx", "fy", "cx", "cy" (pixels) may be given instead of "K". The last seven may be left out. "projection" is
"perspective" (the default), "orthographic" (fx and fy are pixels per metre) or "equirectangular" (pixels per radian of
longitude, to the right, and of latitude, down). "clip" holds depths in metres, planar or, in an equirectangular
picture, along the ray, FAR perhaps null: what is centred nearer or farther is not drawn. "name" is the name of the file
that is written. "frame" and "fps" are for its header. "display" is the window of the picture, in its pixels, that
viewers show (none: all of it). "previous" and "next" are the cameras of the frames beside it, for the layer Vector:
"width", "height", "K", "camera_to_world" and "projection".

preview.json in the lift folder names the camera from which a user wants to see the growing model. The user's program
writes it by rename, at any time; the engine reads it before each live preview, and it never changes the result. It
holds one of

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
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ..errors import PlgsError
from ..gates import create_plain, shortened
from ..json_file import read_object, read_value
from ..records import record_of, to_json
from .atomic import PART

Matrix = tuple[tuple[float, ...], ...]
Projection = Literal["perspective", "orthographic", "equirectangular"]
FARTHEST = 10_000.0
"""Metres from the origin; farther away, 32-bit floats no longer resolve millimetres."""
LARGEST_SIDE = 16384
"""Pixels: the longest side that a camera's picture may have."""
_RIGID_TOLERANCE = 2e-3
LONGEST_NAME = 100
"""The maximum length of a camera's name, in characters."""
_FORBIDDEN = re.compile(r'[<>:"/\\|?*\x00-\x1f]')
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names that Windows forbids for files."""
_FRAME = re.compile(r"[._]\{frame(:0?[1-9]?d)?\}$")
_FIELD = re.compile(r"\{(shot|camera|layer|version(?::(0?[1-9])d)?)\}")
"""A field of a shot's name; only the version has a width."""
_SIDE = {"least": 1, "most": LARGEST_SIDE}
_FIX = "Correct the file; `python -m engine bake --help` explains its content."
_PREVIEW_FIX = "Choose another camera for the preview."


@dataclass(frozen=True)
class PreviewCamera:
    """A camera: ``camera_to_world`` rigid 4x4, ``K`` 3x3 without skew, for a picture of ``width`` x ``height`` pixels.
    It is a pinhole camera unless its ``projection`` says otherwise."""

    camera_to_world: Matrix
    K: Matrix
    width: int = field(metadata=_SIDE)
    height: int = field(metadata=_SIDE)
    projection: Projection = "perspective"

    @property
    def fingerprint(self) -> str:
        """A text that identifies the camera, and stays the same when the camera is written and read again."""
        numbers = [[*map(list, self.camera_to_world)], [*map(list, self.K)], self.width, self.height]
        numbers += [] if self.projection == "perspective" else [self.projection]
        return hashlib.sha256(json.dumps(numbers).encode()).hexdigest()[:16]


PreviewRequest = str | PreviewCamera
"""The name of a frame, or a camera."""


@dataclass(frozen=True)
class BakeCamera:
    """A camera to bake from: ``name`` of the file, ``pinhole``, the planar depths in metres that are drawn (``near`` to
    ``far``), the number of the ``frame`` and the rate (``fps``), the ``display`` window in the picture (left, top,
    width, height), and the cameras of the ``previous`` and the ``next`` frame."""

    name: str
    pinhole: PreviewCamera
    near: float = 0.0
    far: float = math.inf
    frame: int | None = None
    fps: float | None = None
    display: tuple[int, int, int, int] | None = None
    previous: PreviewCamera | None = None
    next: PreviewCamera | None = None

    @property
    def motion(self) -> str:
        """A text that identifies the cameras of the frames before and after (for motion vectors); "" without them."""
        return " ".join(each.fingerprint for each in (self.previous, self.next) if each is not None)

    @property
    def fingerprint(self) -> str:
        """A text that identifies the view: cameras that show the same have the same fingerprint."""
        shows = f"{self.pinhole.fingerprint} {self.near!r} {self.far!r}" + (f" {self.display}" if self.display else "")
        return hashlib.sha256(shows.encode()).hexdigest()[:16]


def read_cameras(path: Path) -> tuple[BakeCamera, ...]:
    """The cameras of a file, in order. Raises PlgsError, which names the camera, if one is invalid."""
    listed = read_value(path, _FIX)
    if not isinstance(listed, list) or not listed:
        raise PlgsError("not-cameras", "does not hold a list of cameras", path, _FIX)
    cameras = []
    for number, each in enumerate(listed, start=1):
        if not isinstance(each, dict):
            raise PlgsError("camera-not-object", f"camera {number} is not a JSON object", path, _FIX)
        cameras.append(record_of(_Entry, each, path, _FIX, f"camera {number}").camera)
    refuse_equal_names([camera.name for camera in cameras], path)
    return tuple(cameras)


def write_cameras(path: Path, cameras: Sequence[BakeCamera]) -> None:
    """Write a file that `read_cameras` reads as exactly these cameras. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{PART}{os.getpid()}-{path.name}")  # several processes may bake the same shot
    part.write_text(json.dumps([_entry(camera) for camera in cameras], allow_nan=False) + "\n", encoding="utf-8")
    os.replace(part, path)


def safe_name(text: str) -> str:
    """Return a file name that is valid on every system, as similar to ``text`` as possible."""
    name = _FORBIDDEN.sub("_", text).strip(". ")[:LONGEST_NAME].rstrip(". ") or "camera"
    return f"_{name}" if _RESERVED.fullmatch(name) else name


def filled_name(template: str, shot: str, camera: str, version: int) -> str:
    """Fill in a ``template`` for the names of a shot's files, without the number of the frame. Its field "layer"
    becomes "passes", as one file holds all layers. Raises ValueError for a template with unknown fields."""
    words = {"shot": shot, "camera": camera, "layer": "passes"}
    template = _FRAME.sub("", template)
    rest = _FIELD.sub("", template)
    if "{" in rest or "}" in rest:
        raise ValueError(f"{shortened(rest, 40)!r} has other braces")
    return _FIELD.sub(lambda found: words.get(found[1]) or f"{version:{found[2] or ''}}", template)


def refuse_equal_names(names: Sequence[str], path: Path, taken: Sequence[str] = ()) -> None:
    """Raise PlgsError for a name that occurs twice or is ``taken`` by a frame. Case is ignored, as on Windows."""
    frames = {name.casefold() for name in taken}
    seen: set[str] = set()
    for name in names:
        if name.casefold() in frames:
            fix = "Give the camera another name, or bake the frame with --frames."
            raise PlgsError("camera-is-frame", f"a frame of the scene is named {name!r}", path, fix, option="--frames")
        if name.casefold() in seen:
            raise PlgsError("same-name", f"two cameras are named {name!r}", path, "Give each camera a different name.")
        seen.add(name.casefold())


def write_preview_request(path: Path, wanted: PreviewRequest) -> None:
    """Replace preview.json. To be fast it is not flushed: a power cut may lose the file. Raises OSError."""
    content = {"frame": wanted} if isinstance(wanted, str) else to_json(wanted)
    part = path.with_name(f"{PART}{os.getpid()}-{path.name}")  # two Blenders may watch one lift
    with create_plain(part) as file:
        file.write((json.dumps(content) + "\n").encode())
    os.replace(part, path)


def read_preview_request(path: Path) -> PreviewRequest | None:
    """The frame or camera that preview.json asks for; None without the file. Raises PlgsError if it names neither."""
    if not path.exists():
        return None
    content = read_object(path, _PREVIEW_FIX)
    frame = content.pop("frame", None)
    if isinstance(frame, str):
        return frame
    try:
        camera = _drawable(record_of(PreviewCamera, content, path, _PREVIEW_FIX))
        if camera.projection != "perspective":
            raise ValueError(f"it is {camera.projection}")
        return camera
    except ValueError as error:
        raise PlgsError("not-a-camera", f"is not a camera ({error})", path, _PREVIEW_FIX) from error


def _drawable(camera: PreviewCamera) -> PreviewCamera:
    """Return the camera itself. Raises ValueError if it cannot be drawn."""
    pose, lens = camera.camera_to_world, camera.K
    for matrix, size in ((pose, 4), (lens, 3)):
        if [len(row) for row in matrix] != [size] * size:
            raise ValueError(f"a matrix does not have {size} rows of {size} numbers")
    rows = [row[:3] for row in pose[:3]]
    for i, one in enumerate(rows):
        for j, other in enumerate(rows):
            if abs(sum(a * b for a, b in zip(one, other, strict=True)) - (i == j)) > _RIGID_TOLERANCE:
                raise ValueError("camera_to_world is not rigid")
    (a, b, c), (d, e, f), (p, q, r) = rows
    if a * (e * r - f * q) - b * (d * r - f * p) + c * (d * q - e * p) < 0:  # the determinant
        raise ValueError("camera_to_world mirrors the picture")
    if max(abs(row[3]) for row in pose[:3]) > FARTHEST:
        raise ValueError(f"the camera is farther than {FARTHEST:.0f} m from the origin")
    if pose[3] != (0.0, 0.0, 0.0, 1.0) or lens[2] != (0.0, 0.0, 1.0):
        raise ValueError("the last row is not that of a camera")
    if lens[0][0] <= 0 or lens[1][1] <= 0 or lens[0][1] or lens[1][0]:
        raise ValueError("K has no focal length, or skew")
    return camera


def _entry(camera: BakeCamera) -> dict[str, object]:
    far = None if math.isinf(camera.far) else camera.far  # JSON has no infinity
    clip = None if far is None and not camera.near else [camera.near, far]
    further: dict[str, object] = {"clip": clip, "frame": camera.frame, "fps": camera.fps, "display": camera.display}
    further |= {"previous": camera.previous and to_json(camera.previous), "next": camera.next and to_json(camera.next)}
    given = {key: value for key, value in further.items() if value is not None}
    return {"name": camera.name, **to_json(camera.pinhole), **given}


@dataclass(frozen=True)
class _Entry:
    """One camera of a file of cameras."""

    name: str
    width: int = field(metadata=_SIDE)
    height: int = field(metadata=_SIDE)
    camera_to_world: Matrix
    projection: Projection = "perspective"
    K: Matrix | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    clip: tuple[float, float | None] | None = None
    frame: int | None = None
    fps: float | None = None
    display: tuple[int, int, int, int] | None = None
    previous: PreviewCamera | None = None
    next: PreviewCamera | None = None

    def __post_init__(self) -> None:
        if not 1 <= len(self.name) <= LONGEST_NAME:
            raise ValueError(f"the name must be a text of 1 to {LONGEST_NAME} characters")
        if safe_name(self.name) != self.name:
            raise ValueError(f"{self.name!r} cannot be the name of a file on every system")
        near, far = self.camera.near, self.camera.far
        if not 0 <= near < far:
            raise ValueError("clip must be [near, far] in metres, with near at least 0 and less than far")
        if self.display is not None and not 1 <= min(self.display[2:]) <= max(map(abs, self.display)) <= LARGEST_SIDE:
            raise ValueError(f"display must be [left, top, width, height] in pixels, none over {LARGEST_SIDE}")

    @property
    def camera(self) -> BakeCamera:
        """The camera of the entry, to bake from. Raises ValueError if it cannot be drawn."""
        pinhole = _drawable(PreviewCamera(self.camera_to_world, self._lens(), self.width, self.height, self.projection))
        near, far = self.clip or (0.0, None)
        far = math.inf if far is None else far
        beside = (each and _drawable(each) for each in (self.previous, self.next))
        return BakeCamera(self.name, pinhole, near, far, self.frame, self.fps, self.display, *beside)

    def _lens(self) -> Matrix:
        given = {"fx": self.fx, "fy": self.fy, "cx": self.cx, "cy": self.cy}
        known = {name: value for name, value in given.items() if value is not None}
        if self.K is not None:
            if known:
                raise ValueError("has both K and fx, fy, cx, cy")
            return self.K
        for name in given:
            if name not in known:
                raise ValueError(f"has no '{name}'")
        return (known["fx"], 0.0, known["cx"]), (0.0, known["fy"], known["cy"]), (0.0, 0.0, 1.0)


_PART = re.compile(r"(-?N)(?:-(-?N)(?:[:x](N))?)?".replace("N", r"\d{1,9}(?:\.\d{1,3})?"))


def frame_numbers(text: str) -> tuple[range, ...]:
    """Parse frames such as "1-250:2,300" into ranges, in thousandths of a frame. Raises ValueError with the reason."""
    found = []
    for part in text.split(","):
        match = _PART.fullmatch(part.strip())
        first, last, step = (round(1000 * float(each or 1)) for each in match.groups()) if match else (0, 0, 0)
        if match is None or not step:
            raise ValueError(f"{text!r} is not a list of frames, such as 1-250, -5-20, 1-250:2, 1-3:0.5 or 1001,1003")
        last = last if match[2] else first
        if last < first:
            raise ValueError(f"{text!r} ends before it begins; a range looks like 1-250")
        found.append(range(first, last + 1, step))
    return tuple(found)
