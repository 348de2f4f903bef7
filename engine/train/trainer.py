"""The training loop: steps, growing and pruning of anchors, pseudo labels, and the losses that a step adds up."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..model.gaussians import no_labels
from ..model.growing import GrowthRound, GrowthRules, GrowthStatistics, grow_and_prune
from ..model.neural_gaussians import NeuralGaussians
from ..model.render import render_view
from ..model.scene_labels import scene_labels
from ..model.structured import NO_OBJECT, StructuredScene
from ..presets.parts import Parts
from ..presets.preset import LossWeights, Preset
from ..raster import Rendering
from ..scene import View
from .arithmetic import IN_TORCH, KERNELS
from .label_losses import TINY, assigned_slots, label_losses
from .optimiser import RATES, Optimiser, Rates
from .self_training import PseudoLabels, pseudo_label_steps, rendered_labels
from .similarity import PhotoMoments, compare, photo_values
from .targets import ViewTargets, columns_of

# The losses of picture, size and depth; those of labels are in ``label_losses`` (the paper's "Loss Functions").

NEAR = 0.5
"""Metres: errors at smaller depths count as much as at this depth."""
NOISY = 4.0
"""Metres: at this depth a sensor's noise, which grows as depth squared, halves the weight of a pixel."""


class StepClock:
    """A profiler, called after every part of a step. This one does nothing; research/bench_step.py's does."""

    def start(self) -> None:
        """Called when a step begins."""

    def lap(self, part: str) -> None:
        """Called at the end of ``part``, a name; the part began at the previous call."""

    def lap_on_way_back(self, tensors: Sequence[torch.Tensor], part: str) -> None:
        """Call ``lap`` as soon as the backward pass reaches one of ``tensors``."""


def reconstruction_loss(
    image: torch.Tensor,  # [H, W, 3], 0 to 1
    photo: PhotoMoments | torch.Tensor,  # [H, W, 3]
    scales: torch.Tensor,  # [N, 3], metres
    *,
    photo_weight: float,
    ssim_weight: float,
    volume_weight: float,
    compare: Callable[..., torch.Tensor] = compare,
) -> torch.Tensor:
    """Return L_recon: ``photo_weight`` (1 in the paper) * (L1 + ``ssim_weight`` (1 - SSIM)) + ``volume_weight`` * the
    sum of the Gaussians' volumes, prod(scales). ``compare`` is `similarity.compare` or `compare_in_torch`."""
    volume = (scales[:, 0] * scales[:, 1] * scales[:, 2]).sum()
    picture = compare(image, photo, 1.0, -ssim_weight) + ssim_weight
    return photo_weight * picture + volume_weight * volume


def depth_loss(
    depth: torch.Tensor,  # [H, W], unnormalised, metres
    alpha: torch.Tensor,  # [H, W], coverage
    sensor: torch.Tensor,  # [H, W], metres, 0 = none
) -> torch.Tensor:
    """Return the depth loss, which is ours: the paper supervises geometry by photos alone. It is the mean, over pixels
    with sensor depth, of min(1, (|D - alpha d| + (1 - alpha) d / 2) / max(d, NEAR)), weighted by the sensor's noise; 0
    without such pixels. D is the rendered ``depth``, d that of the ``sensor``. The limit of 1 makes it robust against
    outliers."""
    known = sensor > 0
    gap = (depth - alpha * sensor).abs() + 0.5 * (1.0 - alpha) * sensor
    weight = known / (1.0 + (sensor / NOISY) ** 2)
    return ((gap / sensor.clamp_min(NEAR)).clamp_max(1.0) * weight).sum() / weight.sum().clamp_min(TINY)


SATURATED = 0.99
"""Value above which a photo may be clipped, so that the room may be brighter."""
LARGEST_SCALE = 1.0
"""Metres. Scales are reduced to this in each round of growth, as Scaffold-GS does in its own units."""


@dataclass(frozen=True)
class GrowthSchedule:
    """When anchors are added and pruned, as shares of all steps, as in Scaffold-GS: statistics from 500/30000 on, a
    round of growth every 100/30000 from 1500/30000 to 15000/30000. In short lifts, rounds are at least
    ``at_least_steps`` apart, or too few views would have seen an anchor to decide on it."""

    statistics_from: float = 500 / 30000
    grow_from: float = 1500 / 30000
    grow_until: float = 0.5
    grow_every: float = 100 / 30000
    at_least_steps: int = 40


@dataclass(frozen=True)
class StepReport:
    """What a step reports: its ``loss``, the loss's parts (0 for labels that the step does not train), the number of
    Gaussians drawn, and ``further`` terms of the loss by name, weights included."""

    step: int
    loss: float
    reconstruction: float
    semantic: float
    instance: float
    gaussians: int
    further: Mapping[str, float] = field(default_factory=dict)

    def numbers(self) -> dict[str, float]:
        """Return all fields by name, ``further`` terms included, for the log."""
        return {**{name: value for name, value in vars(self).items() if name != "further"}, **self.further}


class Losses(NamedTuple):
    """The losses of a step. ``total``, to be minimised, is the weighted sum of all the others."""

    total: torch.Tensor
    reconstruction: torch.Tensor
    semantic: torch.Tensor
    instance: torch.Tensor
    further: Mapping[str, torch.Tensor]


class Step(NamedTuple):
    """What a registered further loss may use: the Gaussians seen by the view's camera, their rendering (its labels are
    None in a step that does not train labels), the view's targets, and the preset's weights."""

    gaussians: NeuralGaussians
    rendering: Rendering
    target: ViewTargets
    weights: LossWeights


def weighted_depth_loss(step: Step) -> torch.Tensor:
    """Return ``depth_loss`` of the step, multiplied by the preset's weight."""
    return step.weights.depth * depth_loss(step.rendering.depth, step.rendering.alpha, step.target.depth)


LOSSES: Parts[Callable[[Step], torch.Tensor]] = Parts("loss", {"depth": weighted_depth_loss})
"""The terms of the loss that the preset's ``losses`` name."""


def register_loss(name: str, loss: Callable[[Step], torch.Tensor]) -> None:
    """Make ``loss`` available, in this process, to presets that list ``name`` in their ``losses``. ``loss`` returns a
    scalar, already multiplied by its weight."""
    LOSSES.register(name, loss)


class Trainer:
    """Trains ``scene`` on ``targets``. Random numbers are drawn from (seed, purpose, number) each time, so a trainer
    restored at step n continues bit for bit as one that never stopped. ``clock`` may measure the parts of a step."""

    growth_schedule: ClassVar[GrowthSchedule] = GrowthSchedule()
    growth_rules: ClassVar[GrowthRules] = GrowthRules()
    rates: ClassVar[Rates] = RATES
    preset: Any
    """A Preset; subclasses may use presets with more options."""

    def __init__(
        self, scene: StructuredScene, targets: Sequence[ViewTargets], views: Sequence[View], preset: Preset, seed: int
    ) -> None:
        self.scene, self.targets, self.views, self.preset, self.seed = scene, targets, views, preset, seed
        self.pseudo: list[PseudoLabels | None] = [None] * len(targets)
        self.step_number = 0
        self.clock = StepClock()
        named = (name for name in preset.losses if name != "depth" or preset.weights.depth)  # weight 0 turns it off
        self.further = {name: LOSSES.chosen(name) for name in named}
        schedule = self.growth_schedule
        self.growth_steps = max(round(schedule.grow_every * preset.steps), schedule.at_least_steps)
        self.pseudo_label_steps = pseudo_label_steps(preset.schedule.self_training_every, preset.steps)
        # As in Scaffold-GS: 1.1 times the greatest distance of a camera from the mean camera centre, in metres.
        centres = np.array([view.camera.centre for view in views])
        extent = 1.1 * max(float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()), 1e-2)  # never 0
        self.optimiser = Optimiser(scene.anchors, scene.decoders, self.rates, extent)
        self.statistics = GrowthStatistics.empty(scene.anchors)
        self.device, self.arithmetic = torch.device("cpu"), KERNELS
        self._placed: dict[int, ViewTargets] = {}
        self.follow_anchors()

    def move_to(self, device: torch.device | str) -> None:
        """Do further steps on this device. The targets of a view are copied there when first used, and stay."""
        self.device = torch.device(device)
        self.arithmetic = KERNELS if self.device.type == "cpu" else IN_TORCH
        self._placed.clear()  # they are on the last device
        self._move_state(self.device)

    def _move_state(self, device: torch.device) -> None:
        self.scene.anchors, self.statistics = self.scene.anchors.on(device), self.statistics.on(device)
        self.scene.decoders.to(device)
        self.optimiser.move_to(self.scene.anchors, device)
        self.follow_anchors()

    @property
    def finished(self) -> bool:
        return self.step_number >= self.preset.last_step

    def follow_anchors(self) -> None:
        """Recompute the anchors' initial channels, after some anchors were added or removed."""
        anchors = self.scene.anchors
        channels = columns_of(anchors.initial_class.numpy(force=True), self.scene.channels.class_ids)
        self.initial_channels = channels.to(anchors.position.device)

    def target(self, number: int) -> ViewTargets:
        """Return the targets of view ``number``, with pseudo labels as soon as they are made."""
        if number in self._placed:
            return self._placed[number]
        pseudo = self.pseudo[number]
        target = self.targets[number] if pseudo is None else pseudo.teach(self.targets[number])
        if self.arithmetic is KERNELS:  # they are made again for each step: to keep those of all views takes memory
            return target
        target = replace(target, columns=self._columns_to_draw(target))
        self._placed[number] = self.arithmetic.place(target, self.device)
        return self._placed[number]

    def step(self, check: Callable[[], None] = lambda: None) -> StepReport:
        """Make pseudo labels if they are due, optimise once on one view, then add and prune anchors if due. Between
        steps, and when ``check`` raises, the state is complete: training continues bit for bit from a checkpoint.
        Raises what ``check`` raises and, before any change, FloatingPointError if the loss is not finite."""
        if self.step_number in self.pseudo_label_steps:
            self.refresh_pseudo_labels(check)
        epoch, position = divmod(self.step_number, len(self.targets))  # each epoch has a new random order of all views
        order = np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.targets))
        target = self.target(int(order[position]))
        self.clock.start()
        with_labels = self.step_number % self.preset.label_every == 0
        gaussians = self._decode(target, with_labels)
        self.clock.lap("decode, forward")
        columns = self._columns_to_draw(target) if with_labels else None
        labels = None if columns is None else gaussians.labels
        if labels is not None and columns is not None and len(columns) < labels.shape[1]:
            # To copy all columns, too, would take a quarter of the paper's step.
            labels = labels.index_select(1, torch.from_numpy(columns).to(labels.device, non_blocking=True))
        backend = self.arithmetic.backend
        rendering = gaussians.drawn_by(target.camera, labels, want_means2d_grad=True, backend=backend)
        self.clock.lap("rasterise, forward")
        losses = self._losses(gaussians, rendering, target, columns)
        drawn = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.colours)
        layers = [rendering.image] if rendering.labels is None else [rendering.image, rendering.labels]
        self.clock.lap_on_way_back(layers, "losses, backward")
        self.clock.lap_on_way_back(drawn, "rasterise, backward")
        losses.total.backward()
        self.clock.lap("decode, backward")
        terms = torch.stack([each.detach() for each in (*losses[:4], *losses.further.values())])
        loss, reconstruction, semantic, instance, *further = terms.tolist()  # on a device this waits for the step
        if not math.isfinite(loss):
            raise FloatingPointError(f"the loss of step {self.step_number + 1} is {loss}; the scene diverged")
        progress, schedule = self.step_number / self.preset.steps, self.growth_schedule
        if schedule.statistics_from <= progress < schedule.grow_until:
            camera, moved = target.camera, rendering.means2d.grad
            assert moved is not None  # it was requested, and the backward pass is over
            self.statistics.add(gaussians, rendering.visible, moved, camera.width, camera.height)
        self.clock.lap("growth statistics")
        self.optimiser.step(progress, gaussians.visible, self.arithmetic.move_rows)
        self.clock.lap("optimiser")
        self.step_number += 1
        self._after_step(with_labels)
        named, count = dict(zip(losses.further, further, strict=True)), len(gaussians.opacities)
        report = StepReport(self.step_number, loss, reconstruction, semantic, instance, count, named)
        self.clock.lap("the rest")
        return report

    def _decode(self, target: ViewTargets, with_labels: bool = True) -> NeuralGaussians:
        """Return the Gaussians that the view's camera sees; with labels, also L_cluster of them."""
        anchors, decoders = self.scene.anchors, self.scene.decoders
        if with_labels:
            channels = self.initial_channels if self.preset.weights.cluster else None
            return self.arithmetic.decode(anchors, decoders, target.camera, channels=channels)
        return self.arithmetic.decode(anchors, decoders, target.camera, known_labels=no_labels(anchors))

    def _columns_to_draw(self, target: ViewTargets) -> NDArray[np.int64]:
        """Return the label channels to render, ascending: the channels that occur in the view's targets, since no loss
        needs others, or all channels if linear assignment chooses slots by what is rendered."""
        if target.columns is not None:
            return target.columns
        classes, total = self._channel_counts()
        if self.preset.linear_assignment:
            return np.arange(total)
        used = torch.zeros(total + 1, dtype=torch.bool)  # the last means no target
        used[target.semantic.long()] = True
        used[torch.where(target.slot < 0, -1, target.slot.long() + classes)] = True
        used[0] |= not used[:-1].any()  # a view without targets still draws one channel
        return used[:-1].numpy().nonzero()[0]

    def _channel_counts(self) -> tuple[int, int]:
        """Return the number of class channels, and the number of all label channels (classes and slots)."""
        classes = len(self.scene.channels.class_ids)
        return classes, classes + self.scene.decoders.shape.instance_slots

    def _losses(
        self, gaussians: NeuralGaussians, rendering: Rendering, target: ViewTargets, columns: NDArray[np.int64] | None
    ) -> Losses:
        """Compare the rendering with the view's targets: L_total and its parts. ``columns``: the label channels that
        were rendered, None if labels were not."""
        weights = self.preset.weights
        reconstruction = reconstruction_loss(
            self._as_photographed(rendering.image, target),
            target.photo,
            gaussians.scales,
            photo_weight=target.weight,
            ssim_weight=weights.ssim,
            volume_weight=weights.volume,
            compare=self.arithmetic.compare,
        )
        self.clock.lap("SSIM, L1, volume")
        semantic, instance = reconstruction.new_zeros(2)
        if columns is not None:
            by_class, instance = self._compare_labels(gaussians, rendering, target, columns)
            semantic = by_class + weights.cluster * gaussians.cluster_loss
        total = reconstruction + weights.semantic * semantic + weights.instance * instance
        given = Step(gaussians, rendering, target, weights)
        further = {name: loss(given) for name, loss in self.further.items()}
        for term in further.values():
            total = total + term
        self.clock.lap("further losses")
        return Losses(total, reconstruction, semantic, instance, further)

    def _as_photographed(self, image: torch.Tensor, target: ViewTargets) -> torch.Tensor:
        """Return the rendered image with the photo's exposure, and its black border, which gets no gradient."""
        if target.gain is None and target.border is None:
            return image
        photo = photo_values(target.photo)
        if target.gain is not None:
            image = image * target.gain
            image = torch.where(photo >= SATURATED, image.clamp_max(1.0), image)
        if target.border is not None:
            image = torch.where(target.border[..., None], photo, image)
        return image

    def _compare_labels(
        self, gaussians: NeuralGaussians, rendering: Rendering, target: ViewTargets, columns: NDArray[np.int64]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return L_sem without L_cluster, and L_ins (linear assignment and M_match). ``columns``: the label channels
        that were rendered. Gradients stop at the blending weights, so labels do not change opacity, shape or colour
        decoders. They do change the anchors' features, which all decoders share, so that labels follow photos."""
        of_classes, total = self._channel_counts()
        classes = int(np.searchsorted(columns, of_classes))
        drawn_column = torch.full((total + 1,), -1, dtype=torch.int16)  # the last means no target
        drawn_column[columns] = torch.arange(len(columns), dtype=torch.int16)
        drawn_column = drawn_column.to(target.slot.device, non_blocking=True)
        assert rendering.labels is not None  # drawn with labels
        assigned = torch.full_like(target.slot, -1)
        if self.preset.linear_assignment:
            no_object = self.scene.channels.slot_ids.index(NO_OBJECT)
            assigned = assigned_slots(rendering.labels, rendering.alpha, classes, target.things, no_object)
            self.clock.lap("linear assignment")
        slot = torch.where(target.slot < 0, -1, drawn_column[target.slot.long() + of_classes] - classes).to(torch.int16)
        semantic = drawn_column[target.semantic.long()]
        losses = label_losses(rendering.labels, rendering.alpha, classes, semantic, (assigned, slot))
        self.clock.lap("label losses")
        return losses

    def _after_step(self, with_labels: bool) -> None:
        """Add and prune anchors if it is due. ``with_labels``: whether the step trained labels."""
        schedule, steps = self.growth_schedule, self.preset.steps
        growing = schedule.grow_from * steps < self.step_number < schedule.grow_until * steps
        if not growing or self.step_number % self.growth_steps:
            return
        self._move_state(torch.device("cpu"))
        round_ = self._growth_round(np.random.default_rng([self.seed, 2, self.step_number]))
        statistics = {name: tensor[round_.keep] for name, tensor in self.statistics.tensors().items()}
        fresh = GrowthStatistics.empty(round_.grown).tensors()
        self.statistics = GrowthStatistics(**{name: torch.cat([statistics[name], fresh[name]]) for name in fresh})
        self.scene.anchors = self.scene.anchors.select(round_.keep).extended(round_.grown)
        self.scene.anchors.log_scale.clamp_(max=math.log(LARGEST_SCALE))
        self.optimiser.replace_anchors(self.scene.anchors, round_.keep)
        self._move_state(self.device)

    def _growth_round(self, random: np.random.Generator) -> GrowthRound:
        return grow_and_prune(
            self.scene.anchors,
            self.statistics,
            replace(self.growth_rules, least_visits=self.preset.growth.least_visits),
            voxel_size=self.scene.voxel_size,
            steps_between=self.growth_steps,
            random=random,
            most_anchors=self.preset.most_anchors,
        )

    def refresh_pseudo_labels(self, check: Callable[[], None] = lambda: None) -> None:
        """Make new pseudo labels for all views (self-training), or for none if ``check`` raises."""
        shown, channels = scene_labels(self.scene), self.scene.channels
        fresh: list[PseudoLabels | None] = []
        least = self.preset.segments.least_region
        for view in self.views:
            check()
            fresh.append(rendered_labels(view.mask, render_view(self.scene, view.camera, shown), channels, least))
        self.pseudo = fresh
        self._placed.clear()  # they have the old labels
