"""The tiny lift by a baseline's options."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

from engine.job import EventWriter, StopSignal
from engine.lift.method import Method, method_in_use, use_method
from engine.lift.preparation import PreparedLift
from engine.lift.run import STAGES
from engine.presets.preset import PRESETS
from engine.scene import ClassTable, View
from engine.train.progress import StageReporter
from engine.train.trainer import Trainer
from research.baselines.method import Baselines, register
from research.baselines.options import BaselinePreset
from tests.train.tiny_lift import TINY

TINY_BASELINE = BaselinePreset(**{each.name: getattr(TINY, each.name) for each in fields(TINY)})


@contextmanager
def registered() -> Iterator[None]:
    """The engine knows the baselines meanwhile."""
    presets, method = dict(PRESETS), method_in_use()
    register()
    try:
        yield
    finally:
        PRESETS.update(presets)
        use_method(method)


def prepared_for(
    views: list[View], classes: ClassTable, preset: BaselinePreset, folder: Path, method: Method | None = None
) -> PreparedLift:
    events = EventWriter(folder / "events.jsonl")
    try:
        stages = StageReporter(events, StopSignal(folder / "cancel"), STAGES)
        return (method or Baselines()).prepare(views, classes, preset, 0, stages)
    finally:
        events.close()


def trainer_of(views: list[View], classes: ClassTable, preset: BaselinePreset, folder: Path) -> Trainer:
    return Baselines().trainer(prepared_for(views, classes, preset, folder), views, preset, 0)
