"""What are the frames? Cameras, frames, class tables, and one reader a format."""

from __future__ import annotations

from ..posed import VOID, Camera, Category, ClassTable, PosedFrame, PosedScene, distinct_colour, size_within
from ..posed.classes import ClassLabel
from ..scene_source import UpAxis
from .checks import check_scene
from .class_listing import ClassList, list_classes
from .class_map import NamedClass
from .class_tables import TABLES, is_thing_by_name, nearest_tables
from .evidence import (
    are_near,
    evidence,
    evidence_of_pixels,
    evidence_of_resolution,
    resolution_of,
    resolution_on,
    resolves,
)
from .formats import FORMATS, SceneFormat
from .frame import Frame, GroundTruth, PanopticMask, Scene, Segment, Size, SparsePoints
from .frame_choice import choose_frames, photo_detail
from .on_demand import OnDemand, StoredArrays, StoredViews, chained, stored
from .opening import open_asked, open_scene, open_scene_to_lift, require_liftable
from .pixels import distinct_ids
from .report import ClassReport, SceneReport, describe
from .view import View, load_view, read_ahead

__all__ = [
    "FORMATS",
    "TABLES",
    "VOID",
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
    "PosedFrame",
    "PosedScene",
    "Scene",
    "SceneFormat",
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
    "choose_frames",
    "describe",
    "photo_detail",
    "distinct_colour",
    "are_near",
    "evidence",
    "evidence_of_pixels",
    "evidence_of_resolution",
    "is_thing_by_name",
    "nearest_tables",
    "list_classes",
    "distinct_ids",
    "load_view",
    "open_asked",
    "open_scene",
    "open_scene_to_lift",
    "read_ahead",
    "require_liftable",
    "resolution_of",
    "resolution_on",
    "resolves",
    "size_within",
    "stored",
]
