"""Which labels are consistent? Consistency-enhanced masks, the semantic point cloud, pseudo labels."""

from __future__ import annotations

from .anchor_labels import label_anchors, voxelise
from .cloud_index import CloudIndex
from .consistency import ConsistencyOptions, consistency_masks, view_overlap, views_are_sparse
from .point_cloud import CloudOptions, SemanticPointCloud, build_point_cloud
from .projection import LabelledPoints, project_labels, read_labels
from .pseudo_labels import pseudo_labels, regions

__all__ = [
    "CloudIndex",
    "CloudOptions",
    "ConsistencyOptions",
    "LabelledPoints",
    "SemanticPointCloud",
    "build_point_cloud",
    "consistency_masks",
    "label_anchors",
    "project_labels",
    "pseudo_labels",
    "read_labels",
    "regions",
    "view_overlap",
    "views_are_sparse",
    "voxelise",
]
