"""The contents of a scene, for ``python -m engine inspect`` and the panel."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..posed.classes import VOID
from .checks import DepthFacts, Survey, survey_scene
from .frame import Scene, Size
from .noted import Inferred, LeftOut, doubts


@dataclass(frozen=True)
class ClassReport:
    """One class of the masks, its ``colour`` in sRGB bytes, and its share of all mask pixels (0..1)."""

    id: int
    name: str
    is_thing: bool
    colour: tuple[int, int, int]
    share: float


@dataclass(frozen=True)
class SceneReport:
    """Counts and ranges over all frames that a lift would use.

    ``format`` is the name of the scene's reader. ``sparse_points`` counts the points of the reconstruction behind the
    poses, ``picture_files`` the frames whose picture is an image file as it is. Sizes are (width, height) with their
    number of frames, the commonest first. ``depth_range`` is the nearest, the median and the farthest depth in metres,
    ``segments_per_frame`` the fewest, the median and the most; they are None without depth or masks. ``void_share`` is
    the share of mask pixels without a label. ``classes`` are those that occur. ``extent`` is the size of the box around
    the cameras' centres, in metres along x, y, z. ``left_out`` are frames that a lift would not use, ``inferred`` is
    what no file says; ``warnings`` are all others.
    """

    folder: Path
    format: str
    train_frames: int
    test_frames: int
    ground_truth_frames: int
    colour_sizes: tuple[tuple[Size, int], ...]
    depth_sizes: tuple[tuple[Size, int], ...]
    mask_sizes: tuple[tuple[Size, int], ...]
    depth_range: tuple[float, float, float] | None
    segments_per_frame: tuple[int, int, int] | None
    classes: tuple[ClassReport, ...]
    void_share: float
    extent: tuple[float, float, float]
    sparse_points: int
    picture_files: int
    left_out: tuple[LeftOut, ...]
    inferred: tuple[Inferred, ...]
    warnings: tuple[str, ...]


def describe(scene: Scene) -> SceneReport:
    """Survey a scene and sum it up. Decodes every frame and raises PlgsError as ``check_scene`` does.

    Depth and masks may be missing.
    """
    return report_of(survey_scene(scene))


def report_of(survey: Survey) -> SceneReport:
    """A survey summed up."""
    scene = survey.scene
    depths = [fact.depth for fact in survey.frames if fact.depth is not None]
    masks = [fact.mask for fact in survey.frames if fact.mask is not None]
    shares: dict[int, float] = dict.fromkeys((VOID, *scene.classes.ids), 0.0)
    for mask in masks:
        for class_id, share in mask.class_pixels:
            shares[class_id] += share / len(masks)
    segments = sorted(mask.segments for mask in masks)
    centres = np.array([frame.camera.centre for frame in scene.frames])
    extent = np.ptp(centres, axis=0)
    return SceneReport(
        folder=scene.folder,
        format=scene.format,
        train_frames=len(scene.train_frames),
        test_frames=len(scene.test_frames),
        ground_truth_frames=sum(frame.read_ground_truth is not None for frame in scene.frames),
        colour_sizes=tuple(Counter(frame.size for frame in scene.frames).most_common()),
        depth_sizes=tuple(Counter(depth.size for depth in depths).most_common()),
        mask_sizes=tuple(Counter(mask.size for mask in masks).most_common()),
        depth_range=_range(depths) if depths else None,
        segments_per_frame=(segments[0], segments[len(segments) // 2], segments[-1]) if segments else None,
        classes=tuple(
            ClassReport(category.id, category.name, category.is_thing, category.colour, shares[category.id])
            for category in scene.classes.categories
            if shares[category.id] > 0.0
        ),
        void_share=shares[VOID],
        extent=(float(extent[0]), float(extent[1]), float(extent[2])),
        sparse_points=0 if scene.points is None else len(scene.points),
        picture_files=sum(frame.file_shows_colour for frame in scene.frames),
        left_out=scene.left_out,
        inferred=scene.inferred,
        warnings=tuple(each for each in scene.warnings + survey.warnings if each not in doubts(scene.inferred)),
    )


def _range(depths: Sequence[DepthFacts]) -> tuple[float, float, float]:
    """The nearest, the median and the farthest depth of a scene, in metres."""
    return (
        min(depth.range[0] for depth in depths),
        float(np.median([depth.range[1] for depth in depths])),
        max(depth.range[2] for depth in depths),
    )
