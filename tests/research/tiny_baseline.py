"""The tiny lift by a baseline's options."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from pathlib import Path

from engine.presets.preset import PRESETS
from engine.scene import ClassTable, View
from engine.train.trainer import Trainer
from research.baselines.method import new_trainer, prepare_baseline
from research.baselines.options import BaselinePreset, with_baseline_options
from tests.train import tiny_lift
from tests.train.tiny_lift import TINY

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


prepared_for = partial(tiny_lift.prepared_for, preparing=prepare_baseline)


def trainer_of(views: list[View], classes: ClassTable, preset: BaselinePreset, folder: Path) -> Trainer:
    prepared = prepared_for(views, classes, preset, folder)
    return new_trainer(prepared.scene, prepared.targets, views, preset, 0)
