"""One reader a format. ``find_format`` tells which one reads a folder or file."""

from __future__ import annotations

from .capture import Capture, Shot
from .recognising import FORMATS, SceneFormat, find_format

__all__ = ["FORMATS", "Capture", "SceneFormat", "Shot", "find_format"]
