"""What is in a scene: for ``python -m engine inspect`` and the panel."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .checks import survey_scene
from .classes import VOID
from .frame import Scene, Size


@dataclass(frozen=True)
class ClassReport:
    """One class of the masks, and its share of all mask pixels (0..1)."""

    id: int
    name: str
    is_thing: bool
    share: float


@dataclass(frozen=True)
class SceneReport:
    """Counts and ranges over all frames that a lift would use.

    Sizes are (width, height) with the number of frames that have them, the commonest first. ``depth_range`` is the
    nearest, the median and the farthest depth in metres; ``segments_per_frame`` the fewest, the median and the most.
    ``void_share`` is the share of mask pixels without a label. ``extent`` is the size of the box around the cameras'
    centres, in metres along x, y, z.
    """

    folder: Path
    train_frames: int
    test_frames: int
    ground_truth_frames: int
    colour_sizes: tuple[tuple[Size, int], ...]
    depth_sizes: tuple[tuple[Size, int], ...]
    mask_sizes: tuple[tuple[Size, int], ...]
    depth_range: tuple[float, float, float]
    segments_per_frame: tuple[int, int, int]
    classes: tuple[ClassReport, ...]
    void_share: float
    extent: tuple[float, float, float]
    warnings: tuple[str, ...]


def describe(scene: Scene) -> SceneReport:
    """Survey a scene and sum it up. Decodes every frame and raises SceneError, as ``check_scene`` does."""
    survey = survey_scene(scene)
    facts = survey.frames
    shares: dict[int, float] = dict.fromkeys((VOID, *scene.classes.ids), 0.0)
    for fact in facts:
        for class_id, share in fact.class_pixels:
            shares[class_id] += share / len(facts)
    segments = sorted(fact.segments for fact in facts)
    centres = np.array([frame.camera.centre for frame in scene.frames])
    extent = np.ptp(centres, axis=0)
    return SceneReport(
        folder=scene.folder,
        train_frames=len(scene.train_frames),
        test_frames=len(scene.test_frames),
        ground_truth_frames=sum(frame.read_ground_truth is not None for frame in scene.frames),
        colour_sizes=tuple(Counter(frame.size for frame in scene.frames).most_common()),
        depth_sizes=tuple(Counter(fact.depth_size for fact in facts).most_common()),
        mask_sizes=tuple(Counter(fact.mask_size for fact in facts).most_common()),
        depth_range=(
            min(fact.depth_range[0] for fact in facts),
            float(np.median([fact.depth_range[1] for fact in facts])),
            max(fact.depth_range[2] for fact in facts),
        ),
        segments_per_frame=(segments[0], segments[len(segments) // 2], segments[-1]),
        classes=tuple(
            ClassReport(category.id, category.name, category.is_thing, shares[category.id])
            for category in scene.classes.categories
        ),
        void_share=shares[VOID],
        extent=(float(extent[0]), float(extent[1]), float(extent[2])),
        warnings=scene.warnings + survey.warnings,
    )
