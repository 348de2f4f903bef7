"""A lift of the tiny room, small enough for a fast test and with every stage of the schedule in it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from engine.job import EventWriter, LiftFolder, LiftRequest, StopSignal, last_run
from engine.job.progress import StageReporter
from engine.lift.preparation import PreparedLift, ViewsToLift, prepare
from engine.lift.run import STAGES, run_lift
from engine.model.growing import GrowthRules
from engine.plates import make_fills
from engine.presets.preset import PRESETS, Growth, Preset, Schedule
from engine.scene import ClassTable, View, load_view, open_scene
from engine.train import warm_start
from engine.train.trainer import GrowthSchedule, Trainer
from tests.tiny_scene import write_tiny_scene

STEPS = 12
WARM_STEPS = 40
TINY = replace(
    PRESETS["preview"],
    steps=STEPS,
    steps_a_view=0.0,
    voxel_size=0.2,
    gaussians_per_anchor=3,
    instance_slots=4,
    schedule=Schedule(self_training_every=1 / 3),  # pseudo labels after steps 4 and 8
    growth=Growth(least_visits=None),
)


class TinyTrainer(Trainer):
    """Anchors grow after steps 3 and 6."""

    growth_schedule = GrowthSchedule(statistics_from=0, grow_from=0, grow_until=0.6, at_least_steps=3)
    growth_rules = GrowthRules(gradient=1e-6, seen_share=0.1, visited_share=0.1)


@contextmanager
def short_warm_start(steps: int = WARM_STEPS) -> Iterator[None]:
    """Decoders are fitted in so few steps meanwhile: 400 take longer than all else of a tiny lift."""
    before = warm_start.STEPS
    warm_start.STEPS = steps
    try:
        yield
    finally:
        warm_start.STEPS = before


@contextmanager
def presets_as(**presets: Preset) -> Iterator[None]:
    """The engine's presets of these names are these meanwhile, with a short warm start."""
    before = dict(PRESETS)
    PRESETS.update(presets)
    try:
        with short_warm_start():
            yield
    finally:
        PRESETS.update(before)
        torch.set_deterministic_debug_mode("default")


def run(folder: LiftFolder, *, resume: bool = False) -> None:
    """Lift into the folder, or go on with it."""
    events = EventWriter(folder.events_path)
    events.hello(threads=1, resumed=resume)
    try:
        run_lift(folder, events, StopSignal(folder.cancel_path), resume=resume, make_fills=make_fills)
    finally:
        events.close()


def lift_into(path: Path, request: LiftRequest) -> LiftFolder:
    """A new lift folder, lifted."""
    folder = LiftFolder.create(path, request)
    run(folder)
    return folder


def warnings_in(events: Path) -> list[str]:
    """What the last run warned of."""
    return [str(event.data["message"]) for event in last_run(events) if event.kind == "warning"]


def views_of(folder: Path, **options: object) -> tuple[list[View], ClassTable]:
    """The tiny room's training views, and its classes."""
    scene = open_scene(write_tiny_scene(folder, frames=8, **options), None, up="z")  # type: ignore[arg-type]
    return [load_view(frame) for frame in scene.train_frames], scene.classes


def prepared_for(
    views: list[View], classes: ClassTable, preset: Preset, folder: Path, seed: int = 0,
    *, warm_steps: int = WARM_STEPS, preparing: Callable[..., PreparedLift] = prepare,
) -> PreparedLift:  # fmt: skip
    events = EventWriter(folder / "events.jsonl")
    try:
        stages = StageReporter(events, StopSignal(folder / "cancel"), STAGES)
        with short_warm_start(warm_steps):
            return preparing(ViewsToLift(views, classes, preset, seed), stages)
    finally:
        events.close()


def trainer_of(views: list[View], classes: ClassTable, preset: Preset, folder: Path, seed: int = 0) -> Trainer:
    prepared = prepared_for(views, classes, preset, folder, seed)
    return TinyTrainer(prepared.scene, prepared.targets, views, preset, seed)


def colour_error(views: list[View], trainer: Trainer) -> float:
    """Mean absolute error of the rendered views, in [0, 1]."""
    from engine.model.render import render_view

    errors = [np.abs(render_view(trainer.scene, view.camera).image - view.colour / 255.0).mean() for view in views]
    return float(np.mean(errors))
