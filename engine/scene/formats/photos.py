"""Pictures without poses: a folder of photos, or a film. No format reads them; COLMAP can find their poses."""

from __future__ import annotations

import re
from pathlib import Path

from ...errors import PlgsError
from ...posed.image_header import read_image_header

SUFFIXES = {".jpg", ".jpeg", ".png"}
_MODELS = {".ply", ".spz", ".splat", ".obj", ".glb", ".gltf", ".usdz", ".fbx", ".stl", ".las", ".laz"}
FILMS = {".mp4", ".mov", ".m4v", ".avi", ".mkv"}
LET_COLMAP = "let COLMAP find the poses with --poses colmap"
"""What to do about missing poses, for the end of a sentence."""
LEAST = 3
"""The least number of photos whose poses can be found."""
_NO_PHOTO = re.compile(r"(?<![a-z])(depths?|depth_?maps?|conf|confidence)(?![a-z])", re.IGNORECASE)
_FOLDERS = ("images", "image", "rgb", "color", "input", ".")
"""Where photos lie, in the order in which the reader of COLMAP's models looks for them."""


def photos_in(place: Path) -> Path | None:
    """The folder that holds a place's photos; None where there are none. Raises OSError."""
    for name in _FOLDERS:
        folder = place / name
        if folder.is_dir() and len(sorted_out(folder)[0]) >= LEAST:
            return folder
    return None


def sorted_out(folder: Path) -> tuple[list[str], list[str]]:
    """The names of a folder's photos, and those of pictures that are depth or confidence. Raises OSError."""
    pictures = sorted(each for each in folder.iterdir() if each.suffix.lower() in SUFFIXES)
    others = {each for each in pictures if _is_measured(each)}
    return [each.name for each in pictures if each not in others], [each.name for each in pictures if each in others]


def _is_measured(picture: Path) -> bool:
    """Whether a picture is depth or confidence: its name says so, or it is a grey PNG of 16 bits."""
    if _NO_PHOTO.search(picture.stem):
        return True
    try:
        header = read_image_header(picture) if picture.suffix.lower() == ".png" else None
    except PlgsError:
        return False  # whoever reads the photos says what is wrong with it
    return header is not None and header.channels == 1 and header.bit_depth == 16


def is_film(place: Path) -> bool:
    """Whether a place is a film, by its name."""
    return place.suffix.lower() in FILMS and place.is_file()


def finished_models(place: Path) -> list[str]:
    """The names of meshes, splats and point clouds, if a place holds nothing but them and textures. Raises OSError."""
    files = [place] if place.is_file() else sorted(place.iterdir())
    if any(each.is_dir() for each in files):
        return []
    models = [each.name for each in files if each.suffix.lower() in _MODELS]
    textured = any(each.suffix.lower() == ".mtl" for each in files)
    photos = None if place.is_file() else photos_in(place)
    return models if photos is None or (textured and photos == place / ".") else []
