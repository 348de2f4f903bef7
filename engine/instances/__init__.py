"""Which masks are one object? Oriented boxes and Algorithm 1, the views' agreement, linear assignment."""

from __future__ import annotations

from .agreement import ViewPoints, shown_classes, view_points
from .consensus import ConsensusOptions, MemberMask, ObjectMasks, find_objects, with_masks_of
from .density_clusters import density_clusters
from .lasting_objects import LastingObjects, ObjectOverlap, lasting_objects, object_overlap
from .linear_assignment import best_slots
from .masks import instance_map, restrict_to_things, vote_instances
from .matching import Evidence, GlobalInstance, MatchingOptions, limit_instances, match_views
from .object_votes import object_classes, vote_classes
from .objects import object_instances
from .oriented_box import OrientedBox, fit_box, intersection_volume
from .panoptic_labels import UNKNOWN_LABEL, PanopticLabels, decide_labels
from .pieces import PieceRules, regroup_pieces
from .segment_votes import (
    SegmentVoting,
    VotedLabels,
    member_labels,
    segment_labels,
    view_labels,
    vote_panoptic_labels,
)
from .segments import LocalInstance, MaskExtent, SegmentOptions, local_instances, mask_extents

__all__ = [
    "density_clusters",
    "object_classes",
    "vote_classes",
    "UNKNOWN_LABEL",
    "PanopticLabels",
    "decide_labels",
    "SegmentVoting",
    "VotedLabels",
    "member_labels",
    "segment_labels",
    "view_labels",
    "vote_panoptic_labels",
    "ConsensusOptions",
    "Evidence",
    "GlobalInstance",
    "LastingObjects",
    "ObjectOverlap",
    "lasting_objects",
    "object_overlap",
    "LocalInstance",
    "MaskExtent",
    "MemberMask",
    "MatchingOptions",
    "ObjectMasks",
    "OrientedBox",
    "PieceRules",
    "SegmentOptions",
    "ViewPoints",
    "best_slots",
    "find_objects",
    "fit_box",
    "instance_map",
    "intersection_volume",
    "limit_instances",
    "local_instances",
    "mask_extents",
    "match_views",
    "object_instances",
    "regroup_pieces",
    "restrict_to_things",
    "shown_classes",
    "view_points",
    "vote_instances",
    "with_masks_of",
]
