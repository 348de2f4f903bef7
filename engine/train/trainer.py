"""The training loop's inside: one step, a round of growth, a round of pseudo labels, and its whole state."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from ..instances import UNKNOWN_LABEL, PanopticLabels, segment_labels
from ..model.baking import decided_labels
from ..model.encoded import EncodedDecoders, TwinDecoders
from ..model.gaussians import decode, no_labels
from ..model.growing import GrowthRound, GrowthStatistics, grow_and_prune
from ..model.neural_gaussians import NeuralGaussians
from ..model.plain import clone_split_prune, reset_opacities
from ..model.render import render_view
from ..model.rendering import PanopticRendering
from ..model.scene_labels import scene_labels
from ..model.structured import NO_OBJECT, StructuredScene
from ..raster import Rendering
from ..scene import VOID, PanopticMask, View
from ..semantics import pseudo_labels
from .assignment import assigned_slots
from .contrastive_loss import contrastive_loss
from .depth_loss import depth_loss
from .identity_loss import identity_loss, neighbour_loss
from .label_losses import label_losses
from .losses import reconstruction_loss
from .optimiser import Optimiser
from .presets import Preset
from .segment_loss import segment_targets
from .step_clock import StepClock
from .targets import PseudoLabels, ViewTargets, columns_of, slots_of

SATURATED = 0.99
"""Where a photo is as bright as can be, the room may be brighter than what is seen of it."""
LARGEST_SCALE = 1.0
"""Metres. Scales are brought back to this at each round of growth, as Scaffold-GS does in its own units."""


@dataclass(frozen=True)
class StepReport:
    """What one step did: its loss and the parts of it."""

    step: int
    loss: float
    reconstruction: float
    semantic: float
    instance: float
    gaussians: int


class Losses(NamedTuple):
    """``total`` is what a step descends: the weighted sum of the others and of the depth loss."""

    total: torch.Tensor
    reconstruction: torch.Tensor
    semantic: torch.Tensor
    instance: torch.Tensor


class Trainer:
    """Trains ``scene`` on ``targets``. Everything random is drawn from (seed, purpose, number), so that a trainer
    restored at step n goes on bit for bit as the one that never stopped. ``clock`` is told of the parts of a step."""

    def __init__(
        self, scene: StructuredScene, targets: Sequence[ViewTargets], views: Sequence[View], preset: Preset, seed: int
    ) -> None:
        self.scene, self.targets, self.views, self.preset, self.seed = scene, targets, views, preset, seed
        self.pseudo: list[PseudoLabels | None] = [None] * len(targets)
        self.step_number = 0
        self.clock = StepClock()
        schedule = preset.schedule
        self.growth_steps = max(round(schedule.grow_every * preset.steps), schedule.grow_every_at_least_steps)
        self.pseudo_label_steps = pseudo_label_steps(schedule.self_training_every, preset.steps)
        self.optimiser = Optimiser(scene.anchors, scene.decoders, preset.rates, _extent(views))
        self.statistics = GrowthStatistics.empty(scene.anchors)
        self.follow_anchors()

    @property
    def finished(self) -> bool:
        return self.step_number >= self.preset.steps

    def follow_anchors(self) -> None:
        """Bring what is derived from the anchors up to date after they were replaced."""
        self.initial_channels = columns_of(self.scene.anchors.initial_class.numpy(), self.scene.channels.class_ids)

    def target(self, number: int) -> ViewTargets:
        """What view ``number`` is supervised with by now."""
        pseudo = self.pseudo[number]
        return self.targets[number] if pseudo is None else self.targets[number].taught(pseudo)

    def _view_of_step(self, step: int) -> ViewTargets:
        """A random order of all views, anew in each epoch."""
        epoch, place = divmod(step, len(self.targets))
        order = np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.targets))
        return self.target(int(order[place]))

    def step(self, check: Callable[[], None] = lambda: None) -> StepReport:
        """New pseudo labels if they are due, one optimisation step on one view, then growth if it is due.

        Between steps, and when ``check`` raises, the state is whole: a checkpoint of it goes on bit for bit. Raises
        what ``check`` does, and FloatingPointError, before anything is changed, when the loss is no finite number.
        """
        if self.step_number in self.pseudo_label_steps:
            self.refresh_pseudo_labels(check)
        target = self._view_of_step(self.step_number)
        self.clock.start()
        with_labels = self.step_number % self.preset.label_every == 0
        gaussians = self._decode(target, with_labels)
        self.clock.lap("decode, forward")
        columns = self._columns_to_draw(target) if with_labels else None
        labels = None if columns is None else gaussians.labels[:, columns]
        rendering = gaussians.drawn_by(target.camera, labels, want_means2d_grad=True)
        self.clock.lap("rasterise, forward")
        losses = self._losses(gaussians, rendering, target, columns)
        loss = losses.total.item()
        if not math.isfinite(loss):
            raise FloatingPointError(f"the loss of step {self.step_number + 1} is {loss}; the scene diverged")
        self._descend(losses.total, gaussians, rendering)
        progress = self.step_number / self.preset.steps
        self._gather_statistics(gaussians, rendering, target, progress)
        self.clock.lap("growth statistics")
        self.optimiser.step(progress)
        if with_labels and isinstance(self.scene.decoders, TwinDecoders):
            self.scene.decoders.follow(self.preset.contrastive.momentum)
        self.clock.lap("optimiser")
        self.step_number += 1
        self._grow_if_due()
        report = StepReport(
            self.step_number,
            loss,
            losses.reconstruction.item(),
            losses.semantic.item(),
            losses.instance.item(),
            len(gaussians.opacities),
        )
        self.clock.lap("the rest")
        return report

    def _decode(self, target: ViewTargets, with_labels: bool = True) -> NeuralGaussians:
        """What the view's camera sees, and with labels L_cluster of it."""
        anchors, decoders = self.scene.anchors, self.scene.decoders
        if with_labels:
            channels = self.initial_channels if self.preset.weights.cluster else None
            return decode(anchors, decoders, target.camera, channels=channels)
        return decode(anchors, decoders, target.camera, known_labels=no_labels(anchors))

    def _columns_to_draw(self, target: ViewTargets) -> torch.Tensor:
        """The label channels that the view is compared in, ascending int64: all, where segments are assigned to slots
        by what is drawn, or segments to classes; else those of its targets, as the losses look at no others, and all of
        an encoding."""
        classes, total = self._channel_counts()
        if self.preset.linear_assignment or self._wants_segments(target):
            return torch.arange(total)
        used = torch.zeros(total + 1, dtype=torch.bool)  # the last is that of no target
        used[target.semantic.long()] = True
        if self.preset.encoding:
            used[classes:total] = True
        else:
            used[torch.where(target.slot < 0, -1, target.slot.long() + classes)] = True
        used[0] |= not used[:-1].any()  # a view without targets draws one channel, as the others draw some
        return torch.nonzero(used[:-1]).reshape(-1)

    def _wants_segments(self, target: ViewTargets) -> bool:
        """Whether the view's segments are to be of one class each in this step."""
        first = self.preset.schedule.segments_from * self.preset.steps
        return target.segments is not None and self.step_number >= first

    def _channel_counts(self) -> tuple[int, int]:
        """How many label channels are of classes, and how many there are."""
        classes = len(self.scene.channels.class_ids)
        return classes, classes + self.scene.decoders.shape.instance_channels

    def _losses(
        self, gaussians: NeuralGaussians, rendering: Rendering, target: ViewTargets, columns: torch.Tensor | None
    ) -> Losses:
        """L_total: what was drawn against the view's targets. Without label losses where no labels were drawn, else
        ``columns`` are their channels."""
        weights = self.preset.weights
        reconstruction = reconstruction_loss(
            self._as_photographed(rendering.image, target),
            target.photo,
            gaussians.scales,
            photo_weight=target.weight,
            ssim_weight=weights.ssim,
            volume_weight=weights.volume,
        )
        self.clock.lap("SSIM, L1, volume")
        semantic, instance = reconstruction.new_zeros(2)
        if columns is not None:
            semantic, instance = self._label_losses(gaussians, rendering, target, columns)
        total = reconstruction + weights.semantic * semantic + weights.instance * instance
        if weights.depth:
            total = total + weights.depth * depth_loss(rendering.depth, rendering.alpha, target.depth)
            self.clock.lap("depth loss")
        return Losses(total, reconstruction, semantic, instance)

    def _as_photographed(self, image: torch.Tensor, target: ViewTargets) -> torch.Tensor:
        """The rendered picture with the photo's exposure, and with its black border, which then has no gradient."""
        photo = torch.from_numpy(target.photo.values)
        if target.gain is not None:
            image = image * target.gain
            image = torch.where(photo >= SATURATED, image.clamp_max(1.0), image)
        if target.border is not None:
            image = torch.where(target.border[..., None], photo, image)
        return image

    def _descend(self, loss: torch.Tensor, gaussians: NeuralGaussians, rendering: Rendering) -> None:
        """The backward pass."""
        drawn = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.colours)
        layers = [rendering.image] if rendering.labels is None else [rendering.image, rendering.labels]
        self.clock.lap_on_way_back(layers, "losses, backward")
        self.clock.lap_on_way_back(drawn, "rasterise, backward")
        loss.backward()
        self.clock.lap("decode, backward")

    def _label_losses(
        self, gaussians: NeuralGaussians, rendering: Rendering, target: ViewTargets, columns: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """L_sem (the view's target and L_cluster) and L_ins (linear assignment and M_match).

        They stop at the blending weights, so nothing of them reaches opacity, shape or colour decoders. They do reach
        the anchors' features, which all decoders share: that is what makes labels follow what the picture shows.
        ``columns``: the channels that were drawn.
        """
        of_classes, total = self._channel_counts()
        classes = int((columns < of_classes).sum())
        place = torch.full((total + 1,), -1, dtype=torch.int16)  # the last is that of no target
        place[columns] = torch.arange(len(columns), dtype=torch.int16)
        semantic = place[target.semantic.long()]
        assert rendering.labels is not None  # drawn with labels
        nothing = torch.full_like(semantic, -1)
        assigned = self._assigned(rendering, classes, target) if self.preset.linear_assignment else nothing
        slot = nothing  # an encoding has none
        if not self.preset.encoding:
            slot = torch.where(target.slot < 0, -1, place[target.slot.long() + of_classes] - classes).to(torch.int16)
        by_class, by_slot = label_losses(rendering.labels, rendering.alpha, classes, semantic, (assigned, slot))
        if self.preset.encoding:
            by_slot = self._encoding_loss(gaussians, rendering.labels[..., classes:], rendering.alpha, target)
        self.clock.lap("label losses")
        weights = self.preset.weights
        if target.segments is not None and self._wants_segments(target):
            wanted = segment_targets(rendering.labels, rendering.alpha, classes, target.segments)
            consistency, _ = label_losses(rendering.labels, rendering.alpha, classes, wanted, (nothing, nothing))
            by_class = by_class + weights.segment * consistency
            self.clock.lap("segment consistency")
        return by_class + weights.cluster * gaussians.cluster_loss, by_slot

    def _assigned(self, rendering: Rendering, classes: int, target: ViewTargets) -> torch.Tensor:
        """The slot of each pixel by linear assignment, int16 [H, W]."""
        assert rendering.labels is not None  # drawn with labels
        slots = self.scene.channels.slot_ids
        assigned = assigned_slots(rendering.labels, rendering.alpha, classes, target.things, slots.index(NO_OBJECT))
        self.clock.lap("linear assignment")
        return assigned

    def _encoding_loss(
        self, gaussians: NeuralGaussians, blended: torch.Tensor, alpha: torch.Tensor, target: ViewTargets
    ) -> torch.Tensor:
        """L_ins where encodings [H, W, E] tell instances apart."""
        random = np.random.default_rng([self.seed, 4, self.step_number])
        if self.preset.instances == "contrastive":
            return contrastive_loss(blended, alpha, target.things, self.preset.contrastive.pixels, random)
        decoders, rules = self.scene.decoders, self.preset.identity
        assert isinstance(decoders, EncodedDecoders)  # as the preset has it
        loss = identity_loss(blended, alpha, target.slot, decoders)
        if rules.weight and self.step_number // self.preset.label_every % rules.every == 0:
            encodings = gaussians.labels[:, self._channel_counts()[0] :]
            loss = loss + rules.weight * neighbour_loss(gaussians.means, encodings, decoders, rules, random)
        return loss

    def _gather_statistics(
        self, gaussians: NeuralGaussians, rendering: Rendering, target: ViewTargets, progress: float
    ) -> None:
        schedule = self.preset.schedule
        if schedule.statistics_from <= progress < schedule.grow_until:
            camera, moved = target.camera, rendering.means2d.grad
            assert moved is not None  # asked for, and the backward pass is over
            self.statistics.add(gaussians, rendering.visible, moved.cpu(), camera.width, camera.height)

    def _grow_if_due(self) -> None:
        schedule, steps = self.preset.schedule, self.preset.steps
        growing = schedule.grow_from * steps < self.step_number < schedule.grow_until * steps
        if growing and self.step_number % self.growth_steps == 0:
            self._grow()
        self._reset_if_due()

    def _grow(self) -> None:
        round_ = self._growth_round(np.random.default_rng([self.seed, 2, self.step_number]))
        statistics = {name: tensor[round_.keep] for name, tensor in self.statistics.tensors().items()}
        fresh = GrowthStatistics.empty(round_.grown).tensors()
        self.statistics = GrowthStatistics(**{name: torch.cat([statistics[name], fresh[name]]) for name in fresh})
        self.scene.anchors = self.scene.anchors.select(round_.keep).extended(round_.grown)
        self.scene.anchors.log_scale.clamp_(max=math.log(LARGEST_SCALE))
        self.optimiser.replace_anchors(self.scene.anchors, round_.keep)
        self.follow_anchors()

    def _growth_round(self, random: np.random.Generator) -> GrowthRound:
        preset = self.preset
        if self.scene.decoders.shape.plain:
            return clone_split_prune(
                self.scene.anchors,
                self.statistics,
                preset.plain,
                extent=self.optimiser.extent,
                random=random,
                most=preset.most_anchors,
            )
        return grow_and_prune(
            self.scene.anchors,
            self.statistics,
            preset.growth,
            voxel_size=self.scene.voxel_size,
            steps_between=self.growth_steps,
            random=random,
            most_anchors=preset.most_anchors,
        )

    def _reset_if_due(self) -> None:
        """Opacities of plain Gaussians, as long as they grow."""
        schedule, rules, steps = self.preset.schedule, self.preset.plain, self.preset.steps
        every = round(rules.reset_share * steps)
        if self.scene.decoders.shape.plain and every >= rules.reset_steps:
            if self.step_number < schedule.grow_until * steps and self.step_number % every == 0:
                reset_opacities(self.scene.anchors, rules)

    def refresh_pseudo_labels(self, check: Callable[[], None] = lambda: None) -> None:
        """Self-training: give each region of the machine's masks the label most of its pixels are rendered with.

        The paper's regions take a class; where an object is of one class throughout, segments take class and object
        together. All views or, when ``check`` raises, none. Pixels where nothing is rendered have no say.
        """
        shown = scene_labels(self.scene)
        relabel = self._panoptic_pseudo_labels if self.scene.channels.class_of_slot else self._class_pseudo_labels
        fresh: list[PseudoLabels | None] = []
        for view in self.views:
            check()
            fresh.append(relabel(view.mask, render_view(self.scene, view.camera, shown)))
        self.pseudo = fresh

    def _class_pseudo_labels(self, mask: PanopticMask, rendering: PanopticRendering) -> PseudoLabels:
        class_ids = np.array(self.scene.channels.class_ids, np.int32)
        coverage = rendering.class_coverage
        rendered = np.where(coverage.any(axis=2), class_ids[coverage.argmax(axis=2)], VOID).astype(np.int32)
        return PseudoLabels.of(columns_of(pseudo_labels(mask, rendered), self.scene.channels.class_ids), None)

    def _panoptic_pseudo_labels(self, mask: PanopticMask, rendering: PanopticRendering) -> PseudoLabels:
        channels = self.scene.channels
        things = frozenset(channels.class_of_slot) - {VOID}
        covered = np.concatenate([rendering.class_coverage, rendering.instance_coverage], axis=2)
        class_id, instance = decided_labels(covered.reshape(-1, covered.shape[2]), channels, things)
        # The instances are numbered 1.. in the order of their slots.
        labels = PanopticLabels(channels.class_ids, tuple(channels.class_of_slot[s] for s in channels.instance_slots))
        label = labels.of_points(class_id, instance).reshape(rendering.alpha.shape)
        label[rendering.alpha <= 0] = UNKNOWN_LABEL
        agreed = segment_labels(mask, label, len(labels), self.preset.segment_voting.agreement)
        classes, instances = labels.classes(agreed), labels.objects(agreed)
        known = classes != VOID
        return PseudoLabels.of(columns_of(classes, channels.class_ids), slots_of(instances, known, channels))


def pseudo_label_steps(every: float, steps: int) -> frozenset[int]:
    """The numbers of steps after which pseudo labels are made: at ``every``, 2 ``every``, ... of all ``steps``, but not
    at their end."""
    points = (round(number * every * steps) for number in range(1, math.ceil(1 / every)))
    return frozenset(point for point in points if 0 < point < steps)


def _extent(views: Sequence[View]) -> float:
    """1.1 times the greatest distance of a camera from the mean camera centre, metres (Scaffold-GS)."""
    centres = np.array([view.camera.centre for view in views])
    return 1.1 * max(float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()), 1e-2)
