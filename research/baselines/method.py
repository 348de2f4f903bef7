"""Lifts of baselines: as in PLGS, except for what the options of ``BaselinePreset`` say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray

from engine.instances.records import object_of_mask
from engine.instances.segment_votes import member_labels
from engine.job import EventWriter, LiftFolder, StopSignal
from engine.lift.objects import labels_of
from engine.lift.preparation import PreparedLift, prepare, starting_anchors, starting_scene
from engine.lift.run import run_lift
from engine.model.structured import StructuredScene
from engine.presets.preset import Preset
from engine.scene import ClassTable, OnDemand, View, stored
from engine.train.progress import StageReporter
from engine.train.targets import ViewTargets, columns_of, slots_of
from engine.train.trainer import Trainer

from ..results import SOURCES
from .gaussian_splatting import PlainDecoders, plain_gaussians
from .options import BaselinePreset
from .trainer import SegmentTrainer, SplattingTrainer


def lift_baseline(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
    """`run_lift` by whichever baseline the preset's options name; without any, PLGS itself. Raises what that
    raises."""
    run_lift(
        folder, events, stop, resume=resume, preparing=prepare_baseline, training=new_trainer, sources=SOURCES
    )


def prepare_baseline(
    views: Sequence[View],
    classes: ClassTable,
    preset: Preset,
    seed: int,
    stages: StageReporter,
    scratch: Path | None = None,
    others: Sequence[View] = (),
) -> PreparedLift:
    """PLGS's start, with another scene, other targets or other label maps in place of its own."""
    options = cast(BaselinePreset, preset)
    has_own_start = options.representation != "structured" or not options.labelled_start
    first = replace(preset, warm_start=False) if has_own_start else preset
    prepared = prepare(views, classes, first, seed, stages, scratch, others)
    if options.vote_from == "masks" and prepared.label_maps is not None:
        prepared = with_labels_of_masks(prepared, views, scratch)
    if has_own_start:
        viewpoints = np.array([view.camera.centre for view in views])
        prepared = replace(prepared, scene=baseline_scene(prepared, viewpoints, options, seed))
    if options.semantic_targets != "projected":
        prepared = with_semantic_targets(prepared, views, options.semantic_targets)
    return prepared


def new_trainer(prepared: PreparedLift, views: Sequence[View], preset: Preset, seed: int) -> Trainer:
    """The trainer of the preset's baseline."""
    options = cast(BaselinePreset, preset)
    kind: type[Trainer] = SplattingTrainer if options.representation == "plain" else SegmentTrainer
    return kind(prepared.scene, prepared.targets, views, preset, seed)


def baseline_scene(
    prepared: PreparedLift, viewpoints: NDArray[np.float64], options: BaselinePreset, seed: int
) -> StructuredScene:
    """The scene before the first step, of the kind that the options name."""
    channels = prepared.scene.channels
    start = starting_anchors(prepared.cloud, prepared.instance_of_point, options)
    if not options.labelled_start:
        start = start._replace(classes=np.zeros_like(start.classes), owners=np.zeros_like(start.owners))
    if options.representation == "plain":
        decoders = PlainDecoders.of_labels(len(channels.class_ids), len(channels.slot_ids))
        gaussians = plain_gaussians(start.positions, start.classes, start.rgb, decoders.shape)
        return StructuredScene(gaussians, decoders, channels, options.voxel_size)
    return starting_scene(start, channels, viewpoints, options, seed)


def with_labels_of_masks(prepared: PreparedLift, views: Sequence[View], scratch: Path | None) -> PreparedLift:
    """Label maps straight from the input masks with their objects, and targets of these."""
    labels = labels_of(prepared.cloud, prepared.instances)
    object_of = object_of_mask(prepared.instances)
    maps = stored((member_labels(view, labels, object_of) for view in views), scratch)
    channels, targets = prepared.scene.channels, prepared.targets

    def target(number: int) -> ViewTargets:
        classes = labels.classes(maps[number])
        matched = slots_of(labels.objects(maps[number]), classes != 0, channels)
        return replace(targets[number], projected=_columns(classes, channels.class_ids), matched=matched)

    return replace(prepared, label_maps=maps, targets=OnDemand(len(views), target))


def with_semantic_targets(prepared: PreparedLift, views: Sequence[View], source: str) -> PreparedLift:
    """Targets whose classes come from the input masks, or that have none."""
    class_ids, targets = prepared.scene.channels.class_ids, prepared.targets

    def target(number: int) -> ViewTargets:
        classes = views[number].mask.class_map()
        projected = _columns(classes if source == "masks" else np.zeros_like(classes), class_ids)
        return replace(targets[number], projected=projected)

    return replace(prepared, targets=OnDemand(len(views), target))


def _columns(classes: NDArray[np.int32], class_ids: tuple[int, ...]) -> torch.Tensor:
    return columns_of(classes, class_ids).to(torch.int16)
