"""Which labels can be believed? Consistency-enhanced masks, the semantic point cloud, pseudo labels."""

from __future__ import annotations

from .anchor_labels import label_anchors, voxelise
from .cloud_index import CloudIndex
from .consistency import ConsistencyOptions, consistency_masks, view_overlap, views_are_sparse
from .object_votes import object_classes, vote_classes
from .panoptic_labels import UNKNOWN_LABEL, PanopticLabels, decide_labels
from .point_cloud import CloudOptions, SemanticPointCloud, build_point_cloud
from .projection import LabelledPoints, project_labels, read_labels
from .pseudo_labels import pseudo_labels, regions
from .segment_votes import SegmentVoting, VotedLabels, member_labels, segment_labels, vote_panoptic_labels

__all__ = [
    "UNKNOWN_LABEL",
    "CloudIndex",
    "CloudOptions",
    "ConsistencyOptions",
    "LabelledPoints",
    "PanopticLabels",
    "SegmentVoting",
    "SemanticPointCloud",
    "VotedLabels",
    "build_point_cloud",
    "consistency_masks",
    "decide_labels",
    "label_anchors",
    "member_labels",
    "object_classes",
    "project_labels",
    "pseudo_labels",
    "read_labels",
    "regions",
    "segment_labels",
    "view_overlap",
    "views_are_sparse",
    "vote_classes",
    "vote_panoptic_labels",
    "voxelise",
]
