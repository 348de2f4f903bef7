"""What are the frames? Cameras, frames, class tables, and one reader a format."""

from __future__ import annotations

from .camera import Camera
from .checks import check_scene
from .classes import VOID, Category, ClassTable, distinct_colour
from .frame import Frame, GroundTruth, PanopticMask, Scene, SceneError, Segment, Size
from .matrices import UpAxis
from .opening import open_scene
from .report import ClassReport, SceneReport, describe
from .view import View, load_view, size_within

__all__ = [
    "VOID",
    "Camera",
    "Category",
    "ClassReport",
    "ClassTable",
    "Frame",
    "GroundTruth",
    "PanopticMask",
    "Scene",
    "SceneError",
    "SceneReport",
    "Segment",
    "Size",
    "UpAxis",
    "View",
    "check_scene",
    "describe",
    "distinct_colour",
    "load_view",
    "open_scene",
    "size_within",
]
