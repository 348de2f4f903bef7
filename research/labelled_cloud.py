"""How much a view's evidence should count, measured on the labelled cloud: it takes seconds, as nothing is trained.

The points get their classes and objects as in a lift. Then the held-out frames read them with their own depth, which a
lifted model is not given. So these figures are only for comparing ways with each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, get_args

import numpy as np
from scipy.ndimage import distance_transform_edt

from engine.gates import markdown_cell
from engine.job import EventWriter, StopSignal
from engine.lift.objects import MATCHINGS, Matching, ViewsToMatch
from engine.lift.preparation import filled_views, semantic_cloud, used_classes
from engine.metrics.panoptic import PanopticEvaluation
from engine.presets.preset import EvidenceKind, Preset, ViewEvidence
from engine.scene import VOID, Scene, StoredViews, load_view, open_scene_to_lift, size_within
from engine.scene_source import SceneSource
from engine.train.progress import StageProgress

from .experiments.scenes import SceneToLift

PLACES = ("objects", "segments", "masks")
"""The places of a view's evidence that the cloud shows. Its points take their classes from the segments' votes, and
there are Gaussians only in a lift."""
REACH = 1.0
"""Metres within which a pixel reads its nearest point."""


class CloudScore(NamedTuple):
    """The mean IoU and PQ-scene, strict, and the mean IoU over the true classes."""

    miou: float
    pq: float
    miou_true: float

    def __str__(self) -> str:
        return f"{100 * self.miou:.1f} / {100 * self.pq:.1f}, {100 * self.miou_true:.1f}"


def ways(shipped: ViewEvidence) -> Iterator[tuple[str, ViewEvidence]]:
    """The ``shipped`` evidence, every kind in all places at once, and every other kind in each place alone."""
    yield "as shipped", shipped
    kinds: tuple[EvidenceKind, ...] = get_args(EvidenceKind)
    for kind in kinds:
        yield f"all: {kind}", replace(shipped, **dict.fromkeys(PLACES, kind))
    for place in PLACES:
        for kind in kinds:
            if kind != getattr(shipped, place):
                yield f"{place}: {kind}", replace(shipped, **{place: kind})


def evidence_table(scenes: Sequence[SceneToLift], preset: Preset) -> Iterator[str]:
    """The lines of a Markdown table: one row per way, one column per scene, and the mean. Raises PlgsError."""
    names = [name for name, _ in ways(preset.evidence)]
    columns = [list(scene_scores(scene, preset)) for scene in scenes]
    yield f"| | {' | '.join(markdown_cell(scene.name) for scene in scenes)} | mean |"
    yield "|---" * (len(scenes) + 2) + "|"
    for name, scores in zip(names, zip(*columns, strict=True), strict=True):
        mean = CloudScore(*np.mean(scores, axis=0).tolist())
        yield f"| {name} | {' | '.join(map(str, (*scores, mean)))} |"


def scene_scores(place: SceneToLift, preset: Preset) -> Iterator[CloudScore]:
    """The score of each of the ``ways``. Raises PlgsError."""
    scene = open_scene_to_lift(SceneSource(place.folder, up=place.up))
    with TemporaryDirectory() as name:
        folder = Path(name)
        read = (load_view(frame, size_within(frame.size, preset.size)) for frame in scene.train_frames)
        views = filled_views(StoredViews(read, folder), folder)
        with closing(EventWriter(folder / "events.jsonl")) as events:
            progress = StageProgress("evidence", events, StopSignal())
            for _, evidence in ways(preset.evidence):
                way = replace(preset, evidence=evidence)
                cloud = semantic_cloud(views, used_classes(views), way, events, progress)
                given = ViewsToMatch(views, cloud, scene.classes, scratch=folder)
                yield score(scene, MATCHINGS[way.objects](given, way, progress))


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
