"""What are the frames? Cameras, frames, class tables, and one reader a format."""

from __future__ import annotations

from .camera import Camera
from .classes import VOID, Category, ClassTable, distinct_colour
from .frame import Frame, GroundTruth, PanopticMask, Scene, SceneError, Segment, Size
from .matrices import UpAxis
from .opening import open_scene
from .view import View, load_view

__all__ = [
    "VOID",
    "Camera",
    "Category",
    "ClassTable",
    "Frame",
    "GroundTruth",
    "PanopticMask",
    "Scene",
    "SceneError",
    "Segment",
    "Size",
    "UpAxis",
    "View",
    "distinct_colour",
    "load_view",
    "open_scene",
]
