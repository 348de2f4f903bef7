"""Lift baselines: PLGS, changed by the options of ``BaselinePreset``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import ClassVar, cast

import numpy as np
import torch
from numpy.typing import NDArray

from engine.job import EventWriter, LiftFolder, StopSignal
from engine.job.progress import StageReporter
from engine.lift.preparation import PreparedLift, ViewsToLift, prepare, starting_anchors, starting_scene
from engine.lift.run import run_lift
from engine.model.growing import GrowthRound
from engine.model.neural_gaussians import NeuralGaussians
from engine.model.structured import StructuredScene
from engine.plates import make_fills
from engine.presets.preset import Preset
from engine.raster import Rendering
from engine.scene import OnDemand, View
from engine.train.label_losses import TINY, ThingSegments, label_losses
from engine.train.optimiser import RATES
from engine.train.targets import ViewTargets, columns_of
from engine.train.trainer import GrowthSchedule, Trainer

from ..results import SOURCES
from .gaussian_splatting import PlainDecoders, PlainRules, clone_split_prune, plain_gaussians, reset_opacities
from .options import BaselinePreset

# The training of baselines: where they differ from ``Trainer``, by the options of ``BaselinePreset``.


class SegmentTrainer(Trainer):
    """A trainer that also teaches all pixels of an input mask's segment one class, after ``FROM`` of the steps."""

    def move_to(self, device: torch.device | str) -> None:
        """Move to a device, but stay on the CPU if segments are kept consistent, as kernels do that."""
        super().move_to("cpu" if self.preset.segment_consistency else device)

    def _keeps_segments(self) -> bool:
        return bool(self.preset.segment_consistency) and self.step_number >= FROM * self.preset.steps

    def _columns_to_draw(self, target: ViewTargets) -> NDArray[np.int64]:
        if self._keeps_segments():
            return np.arange(self._channel_counts()[1])
        return super()._columns_to_draw(target)

    def _compare_labels(
        self, gaussians: NeuralGaussians, rendering: Rendering, target: ViewTargets, columns: NDArray[np.int64]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        by_class, by_slot = super()._compare_labels(gaussians, rendering, target, columns)
        if self._keeps_segments():
            assert rendering.labels is not None  # drawn with labels
            classes, mask = self._channel_counts()[0], self._masks[target.name]
            wanted = segment_targets(rendering.labels, rendering.alpha, classes, mask)
            nothing = torch.full_like(wanted, -1)
            loss, _ = label_losses(rendering.labels, rendering.alpha, classes, wanted, (nothing, nothing))
            by_class = by_class + WEIGHT * loss
            self.clock.lap("segment consistency")
        return by_class, by_slot

    @cached_property
    def _masks(self) -> dict[str, ThingSegments]:
        """Return all segments of each view, by its name."""
        return {view.name: ThingSegments.of(view.mask.ids) for view in self.views}


class SplattingTrainer(SegmentTrainer):
    """The trainer of 3DGS, with its own learning rates and growth."""

    growth_schedule: ClassVar = GrowthSchedule(grow_from=500 / 30000)  # 3DGS's step 500 of 30 000
    rates: ClassVar = {**RATES, "feature": (0.0025, 0.0025), "offset": (1.6e-4, 1.6e-6)}  # first and last rates of 3DGS
    rules: ClassVar = PlainRules()

    def _growth_round(self, random: np.random.Generator) -> GrowthRound:
        anchors, extent, most = self.scene.anchors, self.optimiser.extent, self.preset.most_anchors
        return clone_split_prune(anchors, self.statistics, self.rules, extent=extent, random=random, most=most)

    def _after_step(self, with_labels: bool) -> None:
        """Grow the model and, as long as Gaussians grow, reset opacities."""
        super()._after_step(with_labels)
        steps, every = self.preset.steps, round(self.rules.reset_share * self.preset.steps)
        is_due = every >= self.rules.reset_steps and self.step_number % every == 0
        if is_due and self.step_number < self.growth_schedule.grow_until * steps:
            reset_opacities(self.scene.anchors, self.rules)


def lift_baseline(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
    """Run `run_lift`, which may raise, with the baseline that the preset's options name, else PLGS itself."""
    run_lift(
        folder, events, stop, resume=resume, make_fills=make_fills, preparing=prepare_baseline, training=new_trainer,
        sources=SOURCES,
    )  # fmt: skip


def prepare_baseline(given: ViewsToLift, stages: StageReporter) -> PreparedLift:
    """Prepare a lift as PLGS does, then replace its scene, its targets or its label maps by the baseline's."""
    options, views = cast(BaselinePreset, given.preset), given.views
    has_own_start = options.representation != "structured" or not options.labelled_start
    first = replace(given, preset=replace(options, warm_start=False)) if has_own_start else given
    prepared = prepare(first, stages)
    if has_own_start:
        prepared = replace(prepared, scene=baseline_scene(prepared, views, options, given.seed))
    if options.semantic_targets != "projected":
        prepared = with_semantic_targets(prepared, views, options.semantic_targets)
    return prepared


def new_trainer(
    scene: StructuredScene, targets: Sequence[ViewTargets], views: Sequence[View], preset: Preset, seed: int
) -> Trainer:
    """Return the trainer that the preset's options name: PLGS's, perhaps with consistent segments, or 3DGS's."""
    options = cast(BaselinePreset, preset)
    kind: type[Trainer] = SplattingTrainer if options.representation == "plain" else SegmentTrainer
    return kind(scene, targets, views, preset, seed)


def baseline_scene(
    prepared: PreparedLift, views: Sequence[View], options: BaselinePreset, seed: int
) -> StructuredScene:
    """The scene before the first step, of the kind that the options name."""
    channels = prepared.scene.channels
    start = starting_anchors(prepared.cloud, prepared.instance_of_point, views, options)
    if not options.labelled_start:
        start = start._replace(classes=np.zeros_like(start.classes), owners=np.zeros_like(start.owners))
    if options.representation == "plain":
        decoders = PlainDecoders.of_labels(len(channels.class_ids), len(channels.slot_ids))
        gaussians = plain_gaussians(start.positions, start.classes, start.rgb, decoders.shape)
        return StructuredScene(gaussians, decoders, channels, options.voxel_size)
    viewpoints = np.array([view.camera.centre for view in views])
    return starting_scene(start, channels, viewpoints, options, seed=seed)


def with_semantic_targets(prepared: PreparedLift, views: Sequence[View], source: str) -> PreparedLift:
    """Return ``prepared`` with other classes as targets: the input masks' (``source`` "masks") or "none"."""
    class_ids, targets = prepared.scene.channels.class_ids, prepared.targets

    def target(number: int) -> ViewTargets:
        classes = views[number].mask.class_map()
        projected = columns_of(classes if source == "masks" else np.zeros_like(classes), class_ids, np.int16)
        return replace(targets[number], projected=projected)

    return replace(prepared, targets=OnDemand(len(views), target))


# Panoptic Lifting's segment consistency: all of a segment should have one class, whichever it is.

WEIGHT = 1.2
"""The weight of this loss within L_sem."""
FROM = 0.6
"""The share of all steps before which it has no weight: earlier it would teach what is not learnt yet, and all classes
would become one. Panoptic Lifting starts it at its sixth epoch."""


def segment_targets(coverage: torch.Tensor, alpha: torch.Tensor, classes: int, segments: ThingSegments) -> torch.Tensor:
    """Return the class of each pixel's segment, int16 [H, W], -1 outside of all: the class with the largest mean log
    probability over the segment's pixels, as the model currently shows it. ``coverage`` float32 [H, W, C + S] holds
    blended probabilities, those of the C ``classes`` first; divided by ``alpha`` [H, W] they are probabilities."""
    inside = segments.row.reshape(-1) >= 0
    row = segments.row.reshape(-1)[inside]
    shown = coverage.detach().reshape(-1, coverage.shape[-1]).numpy()[inside, :classes]
    logs = np.log(shown / (alpha.detach().reshape(-1, 1).numpy()[inside] + TINY) + TINY)
    count = len(segments.pixels)
    sums = np.column_stack([np.bincount(row, column, count) for column in logs.T])
    best = np.append(sums.argmax(axis=1) if count else [], -1).astype(np.int16)
    return torch.from_numpy(best[segments.row])  # row -1 is the last entry: no class
