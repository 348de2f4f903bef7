"""The plain numbers of the presets, in their one home: the engine trains by them, and a prediction reads them where
there is no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any


@dataclass(frozen=True)
class Effort:
    """How much work a preset asks for.

    ``size_within`` (width, height): pictures are brought into this box, never enlarged; ``voxel_size`` metres between
    anchors; ``most_points`` and ``most_anchors`` cap cloud and model; ``self_training_every`` is a share of the steps.
    With many views there are ``steps_a_view`` steps for each. Of more than ``most_frames`` frames to train on so many
    are chosen (900: Panoptic Lifting's), 0 takes all; with ``all_frames_vote`` the masks of the others vote. Labels are
    voted in ``vote_rounds`` (0: not at all), by masks within ``vote_size_within``.
    """

    name: str
    steps: int
    size_within: tuple[int, int]
    voxel_size: float
    gaussians_per_anchor: int
    most_points: int = 200_000
    most_anchors: int = 400_000
    self_training_every: float = 1.0
    steps_a_view: float = 0.0
    most_frames: int = 900
    all_frames_vote: bool = True
    vote_size_within: tuple[int, int] = (320, 320)
    vote_rounds: int = 2

    def views_of(self, train_frames: int) -> int:
        """How many of so many frames to train on are lifted."""
        return min(train_frames, self.most_frames) if self.most_frames else train_frames

    def steps_for(self, views: int) -> int:
        """Training steps of a scene with so many training views."""
        return max(self.steps, round(self.steps_a_view * views))


EFFORTS = {
    effort.name: effort
    for effort in (
        Effort(
            "preview",
            steps=500,
            size_within=(200, 200),
            voxel_size=0.06,
            gaussians_per_anchor=4,
            steps_a_view=5,
            most_frames=400,
        ),
        Effort(
            "standard",
            steps=1500,
            size_within=(320, 320),
            voxel_size=0.05,
            gaussians_per_anchor=4,
            steps_a_view=15,
            vote_size_within=(640, 640),
        ),
        Effort(
            "paper",
            steps=30_000,
            size_within=(640, 640),
            voxel_size=0.02,
            gaussians_per_anchor=10,
            most_points=2_000_000,
            most_anchors=2_000_000,
            self_training_every=1 / 6,
            all_frames_vote=False,
            vote_rounds=0,
        ),
    )
}


_IN_GROUPS = {"schedule.self_training_every": "self_training_every"}
"""Fields of Effort whose option is in a group; the others have their option's name."""


def chosen_effort(
    name: str,
    steps: int | None = None,
    size: tuple[int, int] | None = None,
    frames: int | None = None,
    options: Mapping[str, Any] | None = None,
) -> Effort:
    """The preset's effort with the user's steps, size and number of frames (0 = all), and those of the user's
    ``options`` that are of it, which win. Raises KeyError for a name that is none."""
    effort = EFFORTS[name]
    if steps is not None:
        effort = replace(effort, steps=steps, steps_a_view=0.0)
    if frames is not None:
        effort = replace(effort, most_frames=frames)
    if size is not None:
        effort = replace(effort, size_within=size)
    known = {field.name: field.name for field in fields(Effort)} | _IN_GROUPS
    return replace(effort, **{known[option]: value for option, value in (options or {}).items() if option in known})
