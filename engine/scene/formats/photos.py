"""Pictures without poses: a folder of photos, or a video decoded on demand; COLMAP finds the poses."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError, reading
from ...gates import open_plain
from ...posed.image_header import read_image_header
from ...posed.layout import shown_files
from ...scene_source import FILMS
from ..frame import Size

SUFFIXES = {".jpg", ".jpeg", ".png"}
_MODELS = {".ply", ".spz", ".splat", ".obj", ".glb", ".gltf", ".usdz", ".fbx", ".stl", ".las", ".laz"}
LET_COLMAP = "let COLMAP find the poses with lift --poses colmap"  # a fix, for the end of a sentence
CONVERT = (
    "Convert it to color/NAME.jpg, depth/NAME.png (millimetres), pose/NAME.txt (4x4) and intrinsic/"
    "intrinsic_color.txt, as docs/captures.md describes them under Layouts."
)
LEAST = 3  # the fewest photos whose poses can be found
_NO_PHOTO = re.compile(r"(?<![a-z])(depths?|depth_?maps?|conf|confidence)(?![a-z])", re.IGNORECASE)
_FOLDERS = ("images", "image", "rgb", "color", "input", ".")  # searched in the order of COLMAP's reader


def photos_in(place: Path) -> Path | None:
    """Return the folder that holds a scene's photos; None if there are none. Raises OSError."""
    for name in _FOLDERS:
        folder = place / name
        if folder.is_dir() and len(sorted_out(folder)[0]) >= LEAST:
            return folder
    return None


def pictures_by_stem(place: Path) -> dict[str, Path]:
    """The photos in a folder and its usual subfolders, each by its stem and by its whole name. Raises OSError."""
    folders = [place / name for name in _FOLDERS if (place / name).is_dir()]
    photos = [folder / name for folder in reversed(folders) for name in sorted_out(folder)[0]]
    return {name: photo for photo in photos for name in (photo.stem, photo.name)}


def picture_of(photos: Mapping[str, Path], label: str) -> Path | None:
    """Return which of ``pictures_by_stem`` is meant by another program's label for a camera: a name or a path, perhaps
    of Windows, with or without its suffix; None if it means no photo."""
    name = PurePosixPath(label.replace("\\", "/"))
    return photos.get(name.name) or photos.get(name.stem)


def sorted_out(folder: Path) -> tuple[list[str], list[str]]:
    """Return the names of a folder's photos, and those of its depth or confidence pictures. Raises OSError."""
    pictures = sorted(each for each in shown_files(folder) if each.suffix.lower() in SUFFIXES)
    others = {each for each in pictures if _is_measured(each)}
    return [each.name for each in pictures if each not in others], [each.name for each in pictures if each in others]


def _is_measured(picture: Path) -> bool:
    """Whether a picture is depth or confidence: its name says so, or it is a grey PNG of 16 bits."""
    if _NO_PHOTO.search(picture.stem):
        return True
    try:
        header = read_image_header(picture) if picture.suffix.lower() == ".png" else None
    except PlgsError:
        return False  # the reader of the photos reports the error
    return header is not None and header.channels == 1 and header.bit_depth == 16


def is_film(place: Path) -> bool:
    """Whether a path is a video, judged by its name."""
    return place.suffix.lower() in FILMS and place.is_file()


def finished_models(place: Path) -> list[str]:
    """Return the names of meshes, splats and point clouds if a folder holds only these and textures. Raises OSError."""
    files = [place] if place.is_file() else sorted(shown_files(place))
    if any(each.is_dir() for each in files):
        return []
    models = [each.name for each in files if each.suffix.lower() in _MODELS]
    textured = any(each.suffix.lower() == ".mtl" for each in files)
    photos = None if place.is_file() else photos_in(place)
    return models if photos is None or (textured and photos == place / ".") else []


_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")  # an MP4 or MOV begins with one of these
_MATROSKA = b"\x1a\x45\xdf\xa3"
_VIDEO_FIX = "Copy or record it again, or extract its pictures with another tool."


class Video:
    """A video with one decoder for all its frames. It decodes forward; to read an earlier frame, it starts again.
    Orientation tags are ignored, as intrinsics refer to the stored pixels."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._capture: Any = None
        self._next = 0
        self._lock = Lock()

    def frame(self, number: int) -> NDArray[np.uint8]:
        """Return frame ``number``, counted from 0, uint8 [H, W, 3] RGB. Raises PlgsError if it is missing."""
        with self._lock:
            self._go_to(number)
            good, pixels = self._capture.read()
            self._next = number + 1
        if not good or pixels is None:
            what = f"the video has no frame {number}, or it cannot be decoded"
            raise PlgsError("no-frame", what, self.path, _VIDEO_FIX)
        return np.ascontiguousarray(pixels[..., ::-1])

    def _numbers(self, *properties: int) -> list[int]:
        """Return numbers from the file's header, by OpenCV's ``properties``. Raises PlgsError if it is no video."""
        with self._lock:
            self._go_to(0)
            return [int(self._capture.get(each)) for each in properties]

    def size(self) -> Size:
        """(width, height) of its pictures, from its header. Raises PlgsError if it cannot be opened."""
        import cv2

        width, height = self._numbers(cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        if width < 1 or height < 1:
            raise PlgsError("video-size", "the video does not say how large its pictures are", self.path, _VIDEO_FIX)
        return width, height

    def count(self) -> int:
        """The number of frames, from the video's header. Raises PlgsError if that is unreadable or lacks it."""
        import cv2

        (count,) = self._numbers(cv2.CAP_PROP_FRAME_COUNT)
        if count <= 0:
            raise PlgsError("video-count", "the video does not say how many pictures it has", self.path, _VIDEO_FIX)
        return count

    def fps(self) -> float | None:
        """Frames per second, from its header; None if it does not say. Raises PlgsError if it is no video."""
        import cv2

        with self._lock:
            self._go_to(0)
            rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        return rate if 0.0 < rate < np.inf else None

    def _go_to(self, number: int) -> None:
        import cv2

        if self._capture is None or number < self._next:
            _refuse_other_files(self.path)
            self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
            self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
            self._next = 0
            if not self._capture.isOpened():
                self._capture = None
                raise PlgsError("video-unreadable", "the video cannot be opened", self.path, _VIDEO_FIX)
        while self._next < number and self._capture.grab():
            self._next += 1


def _refuse_other_files(path: Path) -> None:
    """Raise PlgsError for files other than videos: the decoder would open the addresses that a playlist lists."""
    with reading(path, _VIDEO_FIX), open_plain(path) as file:
        start = file.read(12)
    is_avi = start[:4] == b"RIFF" and start[8:] == b"AVI "
    if start[4:8] not in _BOXES and not start.startswith(_MATROSKA) and not is_avi:
        raise PlgsError("not-video", "this is not an MP4, MOV, Matroska or AVI video", path, _VIDEO_FIX)
