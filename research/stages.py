"""Where each stage of the paper's method loses panoptic quality: the classes and objects of the training views' pixels.

Each row changes one thing. The table is computed from the scene's masks, and from true masks whose ids are shuffled in
each view.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from engine.errors import PlgsError
from engine.instances.matching import match_views
from engine.instances.records import object_of_mask
from engine.instances.segments import instance_map
from engine.job import EventWriter, LiftFolder, StopSignal
from engine.job.progress import StageProgress
from engine.lift.objects import MATCHERS, Matching, ViewsToMatch, segment_options
from engine.lift.preparation import filled_views, projected_masks, semantic_cloud, used_classes
from engine.metrics.panoptic import PanopticEvaluation
from engine.passes.exr import read_exr
from engine.presets.preset import Preset
from engine.scene import ClassTable, Frame, GroundTruth, PanopticMask, Segment, View, load_view, size_within
from engine.scene import open_scene_to_lift as open_scene
from engine.scene_source import SceneSource

from .experiments.experiment import SceneToLift

Labels = tuple[NDArray[np.int32], NDArray[np.int32]]
"""Classes and instances of a view's pixels, int32 [H, W] each."""
Stage = Callable[[int], Labels]
"""The labels of the view with this number."""


def stages_table(asked: SceneToLift, preset: Preset, lift: Path | None) -> Iterator[str]:
    """The lines of a Markdown table: one row per stage, mIoU / PQ-scene ``strict`` of the training views. ``lift``:
    adds a last row, and needs baked passes of the training frames. Raises PlgsError."""
    scene = open_scene(SceneSource(asked.folder, up=asked.up))
    frames = [frame for frame in scene.train_frames if frame.read_ground_truth is not None]
    if not frames:
        fix = "Choose a scene with the true labels of its training frames."
        raise PlgsError("no-truth", "has no ground truth", asked.folder, fix)
    views = [load_view(frame, size_within(frame.size, preset.size)) for frame in frames]
    truth = [_truth(frame, size_within(frame.size, preset.size)) for frame in frames]
    columns = [
        {name: _scored(stage, truth, scene.classes) for name, stage in stages(of, truth, scene.classes, preset)}
        for of in (views, [_with_true_mask(*pair, scene.classes) for pair in zip(views, truth, strict=True)])
    ]
    yield "| | its masks | true masks, renumbered in each view |"
    yield "|---|---|---|"
    for name, figures in columns[0].items():
        yield f"| {name} | {figures} | {columns[1][name]} |"
    if lift is not None:
        baked = [LiftFolder.open(lift).passes_path / f"{frame.name}.exr" for frame in frames]
        whole = [_truth(frame, frame.size) for frame in frames]

        def layers(number: int) -> Labels:
            shown = read_exr(baked[number])
            return shown.semantic, shown.instance

        yield f"| trained | {_scored(layers, whole, scene.classes)} | |"


def stages(
    views: Sequence[View], truth: Sequence[GroundTruth], classes: ClassTable, preset: Preset
) -> Iterator[tuple[str, Stage]]:
    """The stages that need no training, by name."""
    with TemporaryDirectory() as name, closing(EventWriter(Path(name, "events.jsonl"))) as events:
        progress = StageProgress("stages", events, StopSignal())
        filled = filled_views(views, Path(name)) if preset.fill_holes else views
        cloud = semantic_cloud(filled, used_classes(views), preset, events, progress)
        matching: Matching = MATCHERS.chosen(preset.objects)(ViewsToMatch(filled, cloud, classes), preset, progress)
        number_of = object_of_mask(match_views(filled, classes.thing_ids, segment_options(preset), preset.matching))
        projected = projected_masks(filled, matching, classes, preset, Path(name))
        shown = [view.mask.class_map() for view in views]
        class_of = np.array([0, *(one.class_id for one in matching.instances)], np.int32)

        def one_class(number: int) -> Labels:
            by_point, instance = projected[number]
            return np.where(instance > 0, class_of[instance], by_point), instance

        yield "masks, with their own numbers", lambda n: (shown[n], views[n].mask.ids + 100_000 * (n + 1))
        yield "masks' classes, numbers by Algorithm 1", lambda n: (shown[n], instance_map(views[n], number_of))
        yield "masks' classes, true numbers", lambda n: (shown[n], truth[n].instance)
        yield "projected classes and M_match, which training learns", lambda n: (projected[n][0], projected[n][1])
        yield "the same, one class an object", one_class
        yield "projected classes, true numbers", lambda n: (projected[n][0], truth[n].instance)


def _truth(frame: Frame, size: tuple[int, int]) -> GroundTruth:
    assert frame.read_ground_truth is not None
    return frame.read_ground_truth(size)


def _with_true_mask(view: View, truth: GroundTruth, classes: ClassTable) -> View:
    """The view with its true labels as a mask, whose segments are numbered in an order of its own."""
    is_thing = np.isin(truth.semantic, sorted(classes.thing_ids))
    pairs = np.stack([truth.semantic, np.where(is_thing, truth.instance, 0)], 2).reshape(-1, 2)
    known, number = np.unique(pairs, axis=0, return_inverse=True)
    new = 1 + np.random.default_rng(len(known)).permutation(len(known)).astype(np.int32)
    new[known[:, 0] == 0] = 0
    segments = (Segment(int(n), int(c), int(c) in classes.thing_ids) for n, (c, _) in zip(new, known, strict=True) if n)
    return replace(view, mask=PanopticMask(new[number.reshape(truth.semantic.shape)], tuple(segments)))


def _scored(stage: Stage, truth: Sequence[GroundTruth], classes: ClassTable) -> str:
    evaluation = PanopticEvaluation(classes, "strict")
    for number, true in enumerate(truth):
        evaluation.add(*stage(number), true.semantic, true.instance)
    result = evaluation.result()
    return f"{100 * result.miou:.1f} / {100 * result.pq:.1f}"
