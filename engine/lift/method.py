"""The steps of a lift that another method than PLGS may do in its own way."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..presets.preset import Preset
from ..scene import ClassTable, View
from ..train.progress import StageProgress, StageReporter
from ..train.trainer import Trainer
from .preparation import PreparedLift, prepare


class Method:
    """PLGS. ``research`` has a subclass for what its baselines do otherwise."""

    def refuse_bad_options(self, preset: Preset) -> None:
        """Raise PlgsError for options that do not fit together, before any work."""

    def prepare(
        self,
        views: Sequence[View],
        classes: ClassTable,
        preset: Preset,
        seed: int,
        stages: StageReporter,
        scratch: Path | None = None,
        others: Sequence[View] = (),
    ) -> PreparedLift:
        """Everything before the first step; see the function ``prepare``."""
        return prepare(views, classes, preset, seed, stages, scratch, others)

    def trainer(self, prepared: PreparedLift, views: Sequence[View], preset: Preset, seed: int) -> Trainer:
        """The trainer that does the steps."""
        return Trainer(prepared.scene, prepared.targets, views, preset, seed)

    def finish(
        self, trainer: Trainer, prepared: PreparedLift, classes: ClassTable, progress: StageProgress
    ) -> PreparedLift:
        """Called after the last step, before anything is written. Does nothing here."""
        return prepared


_in_use = Method()


def method_in_use() -> Method:
    """The method of this process's lifts."""
    return _in_use


def use_method(method: Method) -> None:
    """Let this process's lifts use another method."""
    global _in_use
    _in_use = method
