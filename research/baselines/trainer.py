"""The training of baselines: where they differ from ``Trainer``, by the options of ``BaselinePreset``."""

from __future__ import annotations

from functools import cached_property
from typing import ClassVar

import numpy as np
import torch

from engine.model.growing import GrowthRound
from engine.model.neural_gaussians import NeuralGaussians
from engine.raster import Rendering
from engine.train.assignment import ThingSegments
from engine.train.label_losses import label_losses
from engine.train.optimiser import RATES
from engine.train.targets import ViewTargets
from engine.train.trainer import GrowthSchedule, Trainer

from . import segment_loss
from .gaussian_splatting import PlainRules, clone_split_prune, reset_opacities


class SegmentTrainer(Trainer):
    """In addition, the segments of the input masks are kept consistent, once ``segment_loss.FROM`` of the steps are
    done."""

    def _keeps_segments(self) -> bool:
        return bool(self.preset.segment_consistency) and self.step_number >= segment_loss.FROM * self.preset.steps

    def _columns_to_draw(self, target: ViewTargets) -> torch.Tensor:
        if self._keeps_segments():
            return torch.arange(self._channel_counts()[1])
        return super()._columns_to_draw(target)

    def _compare_labels(
        self, gaussians: NeuralGaussians, rendering: Rendering, target: ViewTargets, columns: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        by_class, by_slot = super()._compare_labels(gaussians, rendering, target, columns)
        if self._keeps_segments():
            assert rendering.labels is not None  # drawn with labels
            classes, mask = self._channel_counts()[0], self._masks[target.name]
            wanted = segment_loss.segment_targets(rendering.labels, rendering.alpha, classes, mask)
            nothing = torch.full_like(wanted, -1)
            loss, _ = label_losses(rendering.labels, rendering.alpha, classes, wanted, (nothing, nothing))
            by_class = by_class + segment_loss.WEIGHT * loss
            self.clock.lap("segment consistency")
        return by_class, by_slot

    @cached_property
    def _masks(self) -> dict[str, ThingSegments]:
        """All segments of each view, by its name."""
        return {view.name: ThingSegments.of(view.mask.ids) for view in self.views}


class SplattingTrainer(SegmentTrainer):
    """3DGS: its own learning rates and growth."""

    growth_schedule: ClassVar = GrowthSchedule(grow_from=500 / 30000)
    rates: ClassVar = {**RATES, "feature": (0.0025, 0.0025), "offset": (1.6e-4, 1.6e-6)}
    rules: ClassVar = PlainRules()

    def _growth_round(self, random: np.random.Generator) -> GrowthRound:
        anchors, extent, most = self.scene.anchors, self.optimiser.extent, self.preset.most_anchors
        return clone_split_prune(anchors, self.statistics, self.rules, extent=extent, random=random, most=most)

    def _after_step(self, with_labels: bool) -> None:
        """Growth and, as long as Gaussians grow, resets of opacities."""
        super()._after_step(with_labels)
        steps, every = self.preset.steps, round(self.rules.reset_share * self.preset.steps)
        is_due = every >= self.rules.reset_steps and self.step_number % every == 0
        if is_due and self.step_number < self.growth_schedule.grow_until * steps:
            reset_opacities(self.scene.anchors, self.rules)
