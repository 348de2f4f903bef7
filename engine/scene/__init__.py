"""What are the frames? Cameras, frames, class tables, and one reader a format."""

from __future__ import annotations

from .camera import Camera
from .checks import check_scene
from .classes import VOID, Category, ClassTable, distinct_colour
from .formats import FORMATS
from .frame import Frame, GroundTruth, PanopticMask, Scene, SceneError, Segment, Size
from .liftable import open_scene_to_lift, require_liftable
from .matrices import UpAxis
from .opening import open_scene
from .report import ClassReport, SceneReport, describe
from .sparse_points import SparsePoints
from .view import View, load_view, size_within

__all__ = [
    "FORMATS",
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
    "SparsePoints",
    "UpAxis",
    "View",
    "check_scene",
    "describe",
    "distinct_colour",
    "load_view",
    "open_scene",
    "open_scene_to_lift",
    "require_liftable",
    "size_within",
]
