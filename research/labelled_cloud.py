"""How much a view's evidence should count, measured on the labelled cloud: it takes seconds, as nothing is trained.

The points get their classes and objects as in a lift. Then the held-out frames read them with their own depth, which a
lifted model is not given. So these figures are only for comparing ways with each other.

On request, masks judge, too: a third of the training frames is held back, three times, and reads the points that the
others label. This tells whether a scene's masks could choose its evidence without any ground truth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, get_args

import numpy as np
from scipy.ndimage import distance_transform_edt

from engine.gates import markdown_cell
from engine.job import EventWriter, StopSignal
from engine.lift.objects import MATCHERS, Matching, ViewsToMatch
from engine.lift.preparation import filled_views, semantic_cloud, used_classes
from engine.metrics.panoptic import PanopticEvaluation
from engine.presets.preset import EvidenceKind, Preset
from engine.scene import (
    VOID,
    ClassTable,
    Scene,
    StoredViews,
    View,
    load_view,
    open_scene_to_lift,
    size_within,
)
from engine.scene_source import SceneSource
from engine.train.progress import StageProgress

from .experiments.experiment import SceneToLift

PLACES = ("objects", "segments", "masks")
"""The places of a view's evidence that the cloud shows. Its points take their classes from the segments' votes, and
there are Gaussians only in a lift."""
WITHOUT = {
    "points vote alone": ("neighbours",),
    "near views: like others": ("near",),
    "neither": ("neighbours", "near"),
}
"""What is left out of the votes of segments (``SegmentVoting``)."""
REACH = 1.0
"""Metres within which a pixel reads its nearest point."""


FOLDS = 3
"""The number of parts of the training frames, each of which is held back once."""


class CloudScore(NamedTuple):
    """The mean IoU and PQ-scene, strict, and the mean IoU over the true classes. ``masks``: the mean IoU with masks
    that were held back, over their classes; nan if none were."""

    miou: float
    pq: float
    miou_true: float
    masks: float = float("nan")

    def __str__(self) -> str:
        judged = "" if np.isnan(self.masks) else f", masks {100 * self.masks:.1f}"
        return f"{100 * self.miou:.1f} / {100 * self.pq:.1f}, {100 * self.miou_true:.1f}{judged}"


def ways(shipped: Preset) -> Iterator[tuple[str, Preset]]:
    """The ``shipped`` preset, its votes of segments with less, every kind of evidence in all places at once, and every
    other kind in each place alone."""
    yield "as shipped", shipped
    for name, less in WITHOUT.items():
        yield name, replace(shipped, segment_voting=replace(shipped.segment_voting, **dict.fromkeys(less, False)))
    kinds: tuple[EvidenceKind, ...] = get_args(EvidenceKind)
    for kind in kinds:
        yield f"all: {kind}", _weighing(shipped, dict.fromkeys(PLACES, kind))
    for place in PLACES:
        for kind in kinds:
            if kind != getattr(shipped.evidence, place):
                yield f"{place}: {kind}", _weighing(shipped, {place: kind})


def _weighing(shipped: Preset, kinds: dict[str, EvidenceKind]) -> Preset:
    return replace(shipped, evidence=replace(shipped.evidence, **kinds))


def evidence_table(
    scenes: Sequence[SceneToLift], preset: Preset, masks: str | None = None, *, hold_back: bool = False
) -> Iterator[str]:
    """The lines of a Markdown table: one row per way, one column per scene, and the mean. ``masks`` is a pattern of
    folders, as for the experiments; with ``hold_back``, masks judge. Raises PlgsError."""
    names = [name for name, _ in ways(preset)]
    columns = [list(scene_scores(scene, preset, masks_of(scene, masks), hold_back=hold_back)) for scene in scenes]
    yield f"| | {' | '.join(markdown_cell(scene.name) for scene in scenes)} | mean |"
    yield "|---" * (len(scenes) + 2) + "|"
    for name, scores in zip(names, zip(*columns, strict=True), strict=True):
        mean = CloudScore(*np.mean(scores, axis=0).tolist())
        yield f"| {name} | {' | '.join(map(str, (*scores, mean)))} |"


def masks_of(place: SceneToLift, pattern: str | None) -> Path | None:
    """The masks of a scene by a pattern such as "masks/{scene}"; None for its own."""
    return None if pattern is None else Path(pattern.replace("{scene}", place.name)).resolve()


def scene_scores(
    place: SceneToLift, preset: Preset, masks: Path | None = None, *, hold_back: bool = False
) -> Iterator[CloudScore]:
    """The score of each of the ``ways``. Raises PlgsError."""
    scene = open_scene_to_lift(SceneSource(place.folder, up=place.up, masks=masks))
    with TemporaryDirectory() as name:
        folder = Path(name)
        read = (load_view(frame, size_within(frame.size, preset.size)) for frame in scene.train_frames)
        views = filled_views(StoredViews(read, folder), folder)
        with closing(EventWriter(folder / "events.jsonl")) as events:
            progress = StageProgress("evidence", events, StopSignal())

            def matched(views: Sequence[View], way: Preset) -> Matching:
                cloud = semantic_cloud(views, used_classes(views), way, events, progress)
                return MATCHERS[way.objects](ViewsToMatch(views, cloud, scene.classes, scratch=folder), way, progress)

            for _, way in ways(preset):
                found = score(scene, matched(views, way))
                yield found._replace(masks=judged(views, scene.classes, way, matched)) if hold_back else found


def judged(
    views: Sequence[View], classes: ClassTable, way: Preset, matched: Callable[[Sequence[View], Preset], Matching]
) -> float:
    """The mean IoU of the points with the masks of views that did not label them, over the masks' classes."""
    evaluation = PanopticEvaluation(classes, "strict")
    for fold in range(FOLDS):
        cloud = matched([views[n] for n in range(len(views)) if n % FOLDS != fold], way).cloud
        index, class_id = cloud.index(), np.append(cloud.class_id, VOID)
        for view in (views[n] for n in range(fold, len(views), FOLDS)):
            row = index.nearest_of_pixels(view.camera, view.depth, 2 * cloud.spacing)
            mask = np.where(row < 0, VOID, view.mask.class_map())  # a pixel without a point is not asked
            evaluation.add(class_id[row], np.zeros_like(row), mask, np.zeros_like(row))
    return evaluation.result().miou_true


def score(scene: Scene, matching: Matching) -> CloudScore:
    """What the held-out frames read. A pixel without a labelled point takes the labels of the nearest one that has
    some. Raises PlgsError."""
    index, evaluation = matching.cloud.index(), PanopticEvaluation(scene.classes, "strict")
    class_id, instance = np.append(matching.cloud.class_id, VOID), np.append(matching.instance_of_point, 0)
    for frame in scene.test_frames:
        if frame.read_ground_truth is not None:
            truth = frame.read_ground_truth(frame.size)
            row = index.nearest_of_pixels(frame.camera, frame.depth(frame.size), REACH)
            y, x = distance_transform_edt(class_id[row] == VOID, return_distances=False, return_indices=True)
            read = row[y, x]
            evaluation.add(class_id[read], instance[read], truth.semantic, truth.instance)
    result = evaluation.result()
    return CloudScore(result.miou, result.pq, result.miou_true)
