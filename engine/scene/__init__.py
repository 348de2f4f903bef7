"""What are the frames? Cameras, frames, class tables, and one reader per format."""

from __future__ import annotations

from ..posed import VOID, Camera, Category, ClassTable, PosedFrame, PosedScene, distinct_colour, size_within
from ..posed.classes import ClassLabel
from ..scene_source import UpAxis
from .checks import Survey, check_scene, survey_scene
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
from .files_of_frames import digests_of_files
from .formats import FORMATS, SceneFormat
from .frame import Frame, GroundTruth, PanopticMask, Scene, Segment, Size, SparsePoints
from .frame_choice import choose_frames, evenly_spread, photo_detail
from .masks import MaskReader, OtherClasses
from .noted import Inferred, LeftOut, counted
from .on_demand import OnDemand, Progress, StoredArrays, StoredViews, chained, part_of, stored, watched
from .opening import open_asked, open_scene, open_scene_to_lift, require_liftable, splits_path
from .pixels import distinct_ids
from .report import ClassReport, SceneReport, describe, report_of
from .view import View, load_view, read_ahead
