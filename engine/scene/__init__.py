"""Scenes: cameras, frames, class tables, and one reader per format."""

from __future__ import annotations

from ..posed import VOID, Camera, Category, ClassTable, PosedFrame, PosedScene, distinct_colour, size_within
from ..posed.classes import ClassLabel
from ..scene_source import UpAxis
from .checks import Survey, survey_scene
from .class_map import NamedClass
from .class_tables import TABLES
from .evidence import are_near, evidence, resolution_of, resolution_on, resolves
from .files_of_frames import digests_of_files
from .formats import FORMATS, SceneFormat
from .frame import Evidence, Frame, GroundTruth, Inferred, PanopticMask, Scene, Segment, Size, counted
from .frame_choice import choose_frames, evenly_spread, photo_detail
from .mask_formats.segment_maps import labels_of_config
from .masks import MaskReader, OtherClasses
from .opening import open_asked, open_scene, open_scene_to_lift, require_liftable, splits_path
from .overlapping import EvidenceReader
from .pixels import distinct_ids
from .report import ClassList, ClassReport, SceneReport, list_classes, report_of
from .view import OnDemand, Progress, StoredViews, View, chained, load_view, made_ahead, read_ahead, stored, watched
