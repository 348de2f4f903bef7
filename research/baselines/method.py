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
from engine.lift.preparation import PreparedLift, prepare
from engine.lift.run import run_lift
from engine.lift.starting_scene import starting_anchors, starting_scene
from engine.model.decoders import Decoders, DecoderShape
from engine.model.structured import StructuredScene
from engine.presets.preset import Preset
from engine.scene import ClassTable, OnDemand, View, stored
from engine.train.progress import StageProgress, StageReporter
from engine.train.targets import ViewTargets, columns_of, slots_of
from engine.train.trainer import Trainer

from ..results import SOURCES
from . import contrastive_loss, identity_loss
from .embedding_clusters import with_clusters
from .encodings import EncodedDecoders, EncodedShape, FollowedDecoders, TwiceEncodedShape
from .gaussian_splatting import PlainDecoders, plain_gaussians
from .options import BaselinePreset, refuse_clashing_options
from .trainer import EncodingTrainer, SegmentTrainer, SplattingTrainer


def lift_baseline(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
    """`run_lift` by whichever baseline the preset's options name; without any, PLGS itself. Raises what that raises,
    and PlgsError for options that clash."""
    preset = cast(BaselinePreset, folder.request.chosen_preset)
    refuse_clashing_options(preset)
    run_lift(
        folder,
        events,
        stop,
        resume=resume,
        preparing=prepare_baseline,
        training=new_trainer,
        finishing=with_instances,
        sources=SOURCES,
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
    has_own_start = options.representation != "structured" or options.instances != "slots" or not options.labelled_start
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
    kind: type[Trainer] = SegmentTrainer
    if options.representation == "plain":
        kind = SplattingTrainer
    elif options.instances != "slots":
        kind = EncodingTrainer
    return kind(prepared.scene, prepared.targets, views, preset, seed)


def with_instances(
    trainer: Trainer, prepared: PreparedLift, classes: ClassTable, progress: StageProgress
) -> PreparedLift:
    """After the last step the clusters of contrastive embeddings become the instances."""
    if isinstance(trainer.scene.decoders, FollowedDecoders):
        trainer.scene = with_clusters(trainer.scene, trainer.views, classes.thing_ids, trainer.seed, progress)
        prepared = replace(prepared, scene=trainer.scene)
    return prepared


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

    def new_decoders(shape: DecoderShape, seed: int) -> Decoders:
        if options.instances == "identity":
            return EncodedDecoders(EncodedShape(**vars(shape), encoding=identity_loss.CHANNELS), seed)
        if options.instances == "contrastive":
            return FollowedDecoders(TwiceEncodedShape(**vars(shape), encoding=contrastive_loss.CHANNELS), seed)
        return Decoders(shape, seed)

    return starting_scene(start, channels, viewpoints, options, seed, new_decoders)


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
