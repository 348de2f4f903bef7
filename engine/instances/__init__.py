"""Which masks are one object? Oriented boxes, Algorithm 1, linear assignment."""

from __future__ import annotations

from .linear_assignment import assign_slots
from .masks import instance_map, restrict_to_things, vote_instances
from .matching import Evidence, GlobalInstance, MatchingOptions, match_views, merge_duplicates
from .oriented_box import OrientedBox, fit_box, intersection_volume
from .segments import LocalInstance, SegmentOptions, local_instances

__all__ = [
    "Evidence",
    "GlobalInstance",
    "LocalInstance",
    "MatchingOptions",
    "OrientedBox",
    "SegmentOptions",
    "assign_slots",
    "fit_box",
    "instance_map",
    "intersection_volume",
    "local_instances",
    "match_views",
    "merge_duplicates",
    "restrict_to_things",
    "vote_instances",
]
