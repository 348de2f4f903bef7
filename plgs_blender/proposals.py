"""What may be wrong with a placed lift: proposals for its objects, and the frames in which it is least sure.

The lift's collection keeps both for the panel. `corrections` applies the answers.
"""

from __future__ import annotations

import json
from dataclasses import asdict

import bpy

from ..engine.corrections import (
    CorrectedResult,
    Proposal,
    Proposals,
    entropy_of_views,
    proposals_of,
    read_corrected,
)
from ..engine.errors import PlgsError
from ..engine.job import LiftFolder
from ..engine.job.report import doubt_of_frames, read_metrics
from ..engine.known_scene import known_scene
from .lift_collection import folder_of
from .owned import text_of

PROPOSALS = "plgs_proposals"
"""Property of a lift's collection: what may be wrong with it, JSON."""
VISITED = "plgs_visited"
"""Property of a lift's collection: the uncertain frames that were viewed, one per line."""


def propose(root: bpy.types.Collection) -> Proposals:
    """Look for what may be wrong with a placed lift, and keep it for the panel. Raises PlgsError."""
    return keep_proposals(root, read_corrected(folder_of(root)))


def keep_proposals(root: bpy.types.Collection, result: CorrectedResult) -> Proposals:
    """Look again, at a lift that was just read."""
    found = proposals_of(result)
    root[PROPOSALS] = json.dumps({"open": [asdict(one) for one in found.open], "progress": found.progress})
    return found


def kept_proposals(root: bpy.types.Collection) -> tuple[list[Proposal], str]:
    """What `propose` found, less what was answered since, and the user's progress ("" before `propose`)."""
    try:
        content = json.loads(text_of(root, PROPOSALS) or "{}")
        return [Proposal(**one) for one in content.get("open", ())], str(content.get("progress", ""))
    except (ValueError, TypeError, AttributeError):  # a file may come from somebody else
        return [], ""


def proposal_of(root: bpy.types.Collection, instance: int) -> Proposal:
    """The proposal for an object, the most doubtful one where ``instance`` is 0. Raises PlgsError."""
    for one in kept_proposals(root)[0]:
        if instance in (0, one.instance):
            return one
    raise PlgsError("nothing is proposed", root.name, "Press What May Be Wrong?, or look at another object.")


def next_uncertain(root: bpy.types.Collection) -> tuple[str, int, int]:
    """The unvisited frame of the most doubt, how many frames are then visited, and of how many. After the last
    frame it starts again. Raises PlgsError."""
    folder = LiftFolder.open(folder_of(root))
    frames = known_scene(folder).frames
    drawn = doubt_of_frames(read_metrics(folder)) if (folder.result_path / "metrics.json").is_file() else {}
    points = entropy_of_views(read_corrected(folder.path).points, [frame.camera for frame in frames])
    # Frames that were not drawn when the lift was scored come last, by the points that they see.
    order = sorted(range(len(frames)), key=lambda number: (-drawn.get(frames[number].name, -1.0), -points[number]))
    ranked = [frames[number].name for number in order]
    visited = set(text_of(root, VISITED).split("\n")).intersection(ranked)
    if len(visited) == len(ranked):
        visited = set()
    chosen = next(name for name in ranked if name not in visited)
    root[VISITED] = "\n".join(sorted({*visited, chosen}))
    return chosen, len(visited) + 1, len(ranked)
