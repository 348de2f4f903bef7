"""ScanNet++'s iPhone captures: ``iphone/pose_intrinsic_imu.json`` beside the video and depth.

A frame has ``aligned_pose``, camera-to-world in the laser scan's frame, OpenCV axes, metres, z up, and ``intrinsic``,
3x3. Pictures are ``rgb/frame_000000.jpg`` where they were taken out, else frames of ``rgb.mp4`` or ``rgb.mkv``. Depth
is ``depth/frame_000000.png`` in millimetres where it was taken out, else ``depth.bin``: see ``scannetpp_depth``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..colour import ColourReader
from ..depth import DepthReader, check_depth_header
from ..frame import SceneError, Size
from ..image_header import read_image_header
from ..json_file import read_json_object, take_matrix
from ..layout import files_by_stem, natural_order
from ..matrices import placed
from .capture import Capture, Shot
from .poses import finite_pose
from .scannetpp_depth import DepthFile, DepthFileReader
from .video import Video, VideoColour

LOOKS_FOR = "iphone/pose_intrinsic_imu.json"
_FIX = "Download the iPhone data of the scene again."
_TABLE = "pose_intrinsic_imu.json"


def recognises(place: Path) -> bool:
    return (place / _TABLE).is_file() or (place / "iphone" / _TABLE).is_file()


def read(place: Path) -> Capture:
    """Open the frames; headers of images, at most one picture of the video is decoded. Raises SceneError."""
    folder = place if (place / _TABLE).is_file() else place / "iphone"
    table = read_json_object(folder / _TABLE)
    pictures = files_by_stem(folder / "rgb", {".jpg", ".png"}, _FIX) if (folder / "rgb").is_dir() else None
    video = None if pictures else _video(folder)
    size = None if video is None else video.size()
    depths = files_by_stem(folder / "depth", {".png"}, _FIX) if (folder / "depth").is_dir() else {}
    stream = DepthFile(folder / "depth.bin") if not depths and (folder / "depth.bin").is_file() else None
    shots, lost = [], []
    for name in sorted(table, key=natural_order):
        number = re.fullmatch(r"frame_(\d+)", name)
        if number is None or not isinstance(table[name], dict):
            raise SceneError(f'"{name[:40]}" is no frame', folder / _TABLE, _FIX)
        if pictures is not None and name not in pictures:
            continue  # only some were taken out
        pose = _pose(table[name], name, folder / _TABLE)
        if pose is None:
            lost.append(name)
            continue
        path = video.path if video else pictures[name]  # type: ignore[index]
        lens = _lens(table[name], name, size or read_image_header(path).size, folder / _TABLE)
        colour: Callable[[Size | None], NDArray[np.uint8]] = (
            VideoColour(video, int(number[1])) if video else ColourReader(path)
        )
        depth_path, depth = _depth(name, int(number[1]), depths, stream, lens)
        shots.append(Shot(name, placed(lens, pose), path, colour, depth_path, depth, file_shows_colour=not video))
    return Capture(tuple(shots), "z", tuple(lost), up_is_known=True)


def _video(folder: Path) -> Video:
    for name in ("rgb.mp4", "rgb.mkv"):
        if (folder / name).is_file():
            return Video(folder / name)
    raise SceneError("the pictures are missing", folder / "rgb.mkv", _FIX)


def _pose(entry: dict[str, Any], name: str, path: Path) -> NDArray[np.float64] | None:
    if "aligned_pose" not in entry:
        return None
    return finite_pose(take_matrix(entry, "aligned_pose", name, path, ((4, 4),)), path)


def _lens(entry: dict[str, Any], name: str, size: Size, path: Path) -> Camera:
    """A camera at the origin; the file does not say where pixels are counted from: their corners."""
    K = take_matrix(entry, "intrinsic", name, path, ((3, 3),))
    fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    width, height = size
    if not (0.0 < fx < 1e6 and 0.0 < fy < 1e6 and 0.0 <= cx <= width and 0.0 <= cy <= height):
        raise SceneError(f"the intrinsics of {name} do not fit pictures of {width}x{height}", path, _FIX)
    return Camera(width, height, fx, fy, cx, cy, np.eye(4))


def _depth(
    name: str, number: int, depths: dict[str, Path], stream: DepthFile | None, lens: Camera
) -> tuple[Path | None, Callable[[Size | None], NDArray[np.float32]] | None]:
    """Where a frame's depth lies, and its reader; None for both where there is none. Raises SceneError."""
    if stream is not None:
        return stream.path, DepthFileReader(stream, number)
    if not depths:
        return None, None
    if name not in depths:
        raise SceneError(f"{name} has no depth", next(iter(depths.values())).parent, "Take out depth for all pictures.")
    check_depth_header(depths[name], lens)
    return depths[name], DepthReader(depths[name])
