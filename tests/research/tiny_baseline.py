"""The tiny lift by a baseline's options."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

from engine.job import EventWriter, StopSignal
from engine.lift.preparation import PreparedLift
from engine.lift.run import STAGES, Preparing
from engine.presets.preset import PRESETS
from engine.scene import ClassTable, View
from engine.train.progress import StageReporter
from engine.train.trainer import Trainer
from research.baselines.method import new_trainer, prepare_baseline
from research.baselines.options import BaselinePreset, with_baseline_options
from tests.train.tiny_lift import TINY, short_warm_start

TINY_BASELINE = BaselinePreset(**{each.name: getattr(TINY, each.name) for each in fields(TINY)})


@contextmanager
def registered() -> Iterator[None]:
    """Meanwhile the presets have the baselines' options."""
    presets = dict(PRESETS)
    with_baseline_options()
    try:
        yield
    finally:
        PRESETS.update(presets)


def prepared_for(
    views: list[View],
    classes: ClassTable,
    preset: BaselinePreset,
    folder: Path,
    preparing: Preparing = prepare_baseline,
) -> PreparedLift:
    events = EventWriter(folder / "events.jsonl")
    try:
        stages = StageReporter(events, StopSignal(folder / "cancel"), STAGES)
        with short_warm_start():
            return preparing(views, classes, preset, 0, stages)
    finally:
        events.close()


def trainer_of(views: list[View], classes: ClassTable, preset: BaselinePreset, folder: Path) -> Trainer:
    return new_trainer(prepared_for(views, classes, preset, folder), views, preset, 0)
