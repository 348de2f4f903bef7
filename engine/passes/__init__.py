"""Views to layers: EXR, Cryptomatte, previews, COCO panoptic, PLY, and the arrays of a result."""

from __future__ import annotations

from .baked_view import BakedView, Matte, ShownInstances, bake_view
from .coco import write_coco
from .contact_sheet import SheetRow, chosen, write_contact_sheet
from .exr import read_exr, read_note, write_exr
from .layers import PanopticLayers, decide, encoded, linear
from .ply import write_ply
from .previews import (
    colour_picture,
    instance_picture,
    panoptic_picture,
    png_bytes,
    preview_paths,
    semantic_picture,
    write_previews,
)
from .result_files import InstanceRecord, SegmentLink, write_anchors, write_instances, write_semantic_points
from .surface import Surface, surface_of

__all__ = [
    "BakedView",
    "InstanceRecord",
    "Matte",
    "PanopticLayers",
    "SegmentLink",
    "SheetRow",
    "ShownInstances",
    "Surface",
    "bake_view",
    "chosen",
    "colour_picture",
    "decide",
    "encoded",
    "instance_picture",
    "linear",
    "panoptic_picture",
    "png_bytes",
    "preview_paths",
    "read_exr",
    "read_note",
    "semantic_picture",
    "surface_of",
    "write_anchors",
    "write_coco",
    "write_contact_sheet",
    "write_exr",
    "write_instances",
    "write_ply",
    "write_previews",
    "write_semantic_points",
]
