"""What are the frames? Cameras, frames, class tables, and one reader a format."""

from __future__ import annotations

from .camera import Camera
from .checks import check_scene
from .class_listing import ClassList, class_list_path, class_list_text, list_classes
from .class_map import NamedClass
from .class_tables import TABLES, is_thing_by_name
from .classes import VOID, Category, ClassLabel, ClassTable, distinct_colour
from .formats import FORMATS
from .frame import Frame, GroundTruth, PanopticMask, Scene, SceneError, Segment, Size
from .frame_choice import choose_frames
from .liftable import open_scene_to_lift, require_liftable
from .matrices import UpAxis
from .on_demand import OnDemand, StoredArrays, chained, stored
from .opening import AskedScene, open_asked, open_scene
from .pixels import distinct_ids
from .reading_ahead import read_ahead
from .report import ClassReport, SceneReport, describe
from .sharpness import photo_detail
from .sparse_points import SparsePoints
from .stored_views import StoredViews
from .view import View, load_view, size_within

__all__ = [
    "FORMATS",
    "TABLES",
    "VOID",
    "AskedScene",
    "Camera",
    "Category",
    "ClassLabel",
    "ClassList",
    "ClassReport",
    "ClassTable",
    "Frame",
    "GroundTruth",
    "NamedClass",
    "OnDemand",
    "PanopticMask",
    "Scene",
    "SceneError",
    "SceneReport",
    "Segment",
    "Size",
    "SparsePoints",
    "StoredArrays",
    "StoredViews",
    "UpAxis",
    "View",
    "chained",
    "check_scene",
    "class_list_path",
    "class_list_text",
    "choose_frames",
    "describe",
    "photo_detail",
    "distinct_colour",
    "is_thing_by_name",
    "list_classes",
    "distinct_ids",
    "load_view",
    "open_asked",
    "open_scene",
    "open_scene_to_lift",
    "read_ahead",
    "require_liftable",
    "size_within",
    "stored",
]
