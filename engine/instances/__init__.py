"""Which masks are one object? Oriented boxes and Algorithm 1, the views' consent, linear assignment."""

from __future__ import annotations

from .consensus import ConsensusOptions, MemberMask, ObjectMasks, ViewPoints, find_objects, shown_classes
from .linear_assignment import assign_slots, best_slots
from .masks import instance_map, restrict_to_things, vote_instances
from .matching import Evidence, GlobalInstance, MatchingOptions, limit_instances, match_views
from .objects import object_instances, without_strays
from .oriented_box import OrientedBox, fit_box, intersection_volume
from .segments import LocalInstance, MaskExtent, SegmentOptions, local_instances, mask_extents

__all__ = [
    "ConsensusOptions",
    "Evidence",
    "GlobalInstance",
    "LocalInstance",
    "MaskExtent",
    "MemberMask",
    "MatchingOptions",
    "ObjectMasks",
    "OrientedBox",
    "SegmentOptions",
    "ViewPoints",
    "assign_slots",
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
    "restrict_to_things",
    "shown_classes",
    "vote_instances",
    "without_strays",
]
