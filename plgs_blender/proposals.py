"""Find what may be wrong with a placed lift, and which of its frames are uncertain, and keep it for the panel."""

from __future__ import annotations

import json
from dataclasses import asdict

import bpy

from ..engine.corrections.proposals import Proposal, Proposals, entropy_of_views, proposals_of
from ..engine.corrections.result import CorrectedResult, read_corrected
from ..engine.errors import PlgsError
from ..engine.job import LiftFolder
from ..engine.job.report import doubt_of_frames, read_metrics
from ..engine.known_scene import known_scene
from .owned import folder_of, text_of

PROPOSALS = "plgs_proposals"
"""Property of a lift's collection: the proposed corrections as JSON."""
VISITED = "plgs_visited"
"""Property of a lift's collection: the uncertain frames already viewed, one per line."""


def propose(root: bpy.types.Collection) -> Proposals:
    """Find what may be wrong with a placed lift, and store it for the panel. Raises PlgsError for a damaged lift."""
    return keep_proposals(root, read_corrected(folder_of(root)))


def keep_proposals(root: bpy.types.Collection, result: CorrectedResult) -> Proposals:
    """Find and store proposals for a result that was just read."""
    found = proposals_of(result)
    root[PROPOSALS] = json.dumps({"open": [asdict(one) for one in found.open], "progress": found.progress})
    return found


def kept_proposals(root: bpy.types.Collection) -> tuple[list[Proposal], str]:
    """The open proposals, without those answered since `propose`, and the user's progress in words ("" before that)."""
    try:
        content = json.loads(text_of(root, PROPOSALS) or "{}")
        return [Proposal(**one) for one in content.get("open", ())], str(content.get("progress", ""))
    except (ValueError, TypeError, AttributeError):  # a file may come from somebody else
        return [], ""


def proposal_of(root: bpy.types.Collection, instance: int) -> Proposal:
    """Return the proposal for an object, or for 0 the most doubtful one. Raises PlgsError if there is none."""
    for one in kept_proposals(root)[0]:
        if instance in (0, one.instance):
            return one
    what = "nothing is proposed"
    raise PlgsError("no-proposal", what, root.name, "Press What May Be Wrong?, or look at another object.")


def next_uncertain(root: bpy.types.Collection) -> tuple[str, int, int]:
    """Return the most uncertain unvisited frame, how many frames are then visited, and the number of all frames. After
    the last frame it starts again. Raises PlgsError if the lift is damaged."""
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
