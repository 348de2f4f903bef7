"""Pictures without poses: a folder of photos, or a film. No format reads them; COLMAP can find their poses."""

from __future__ import annotations

from pathlib import Path

SUFFIXES = {".jpg", ".jpeg", ".png"}
FILMS = {".mp4", ".mov", ".m4v", ".avi", ".mkv"}
LEAST = 3
"""The least number of photos whose poses can be found."""
_FOLDERS = ("images", "image", "rgb", "color", "input", ".")
"""Where photos lie, in the order in which the reader of COLMAP's models looks for them."""


def photos_in(place: Path) -> Path | None:
    """The folder that holds a place's photos; None where there are none. Raises OSError."""
    for name in _FOLDERS:
        folder = place / name
        if folder.is_dir() and sum(each.suffix.lower() in SUFFIXES for each in folder.iterdir()) >= LEAST:
            return folder
    return None


def is_film(place: Path) -> bool:
    """Whether a place is a film, by its name."""
    return place.suffix.lower() in FILMS and place.is_file()
