"""The command ``python -m research bench step``: measure the parts of a training step, and the speed of drawing."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch.autograd.graph import register_multi_grad_hook

from engine.job import EventWriter, StopSignal
from engine.job.progress import StageReporter
from engine.job.system import peak_bytes
from engine.lift.preparation import PreparedLift, ViewsToLift, prepare
from engine.lift.run import STAGES
from engine.model.gaussians import visible_anchors
from engine.model.render import render_view
from engine.model.scene_labels import scene_labels
from engine.passes.layers import decide
from engine.presets.preset import PRESETS, Preset
from engine.scene import ClassTable, View, load_view, open_scene, size_within
from engine.train.trainer import StepClock, Trainer

SAMPLE = Path(__file__).resolve().parents[1] / "sample" / "room"
SIZE = (640, 480)
"""Pixels to which the sample's frames are enlarged: only time is measured, not what is seen."""
EVERY = 4
"""Every n-th training frame is lifted: enough to see all of the room."""
VOXEL_SIZE = 0.09
"""Metres; gives about 50 000 anchors for the sample."""
WARM_UP_STEPS = 3
STEPS = 32
"""Steps and pictures that are measured."""


class MeasuringClock(StepClock):
    """Keeps the wall seconds of each part of each step in ``steps``. A part reported twice in a step adds up."""

    def __init__(self) -> None:
        self.steps: list[dict[str, float]] = []
        self._last = 0.0

    def start(self) -> None:
        self.steps.append({})
        self._last = time.perf_counter()

    def lap(self, part: str) -> None:
        now = time.perf_counter()
        parts = self.steps[-1]
        parts[part] = parts.get(part, 0.0) + now - self._last
        self._last = now

    def lap_on_way_back(self, tensors: Sequence[torch.Tensor], part: str) -> None:
        # The backward pass runs nodes in reverse order, so everything that came after runs before.
        register_multi_grad_hook(tensors, lambda gradient: self.lap(part), mode="any")


def bench_step(preset: Preset | None = None) -> dict[str, Any]:
    """Prepare a lift of the bundled sample, measure its steps and its pictures, print the times and return them. A
    ``preset`` is lifted as it is; without one the frames are enlarged, so that the rasteriser counts more. Raises
    PlgsError if the sample is missing."""
    scene = open_scene(SAMPLE, None, up="z")
    if preset is None:
        preset = replace(PRESETS["standard"], size=SIZE, voxel_size=VOXEL_SIZE)
        views = [load_view(frame, SIZE) for frame in scene.train_frames[::EVERY]]
    else:
        views = [load_view(frame, size_within(frame.size, preset.size)) for frame in scene.train_frames]
    print(f"{torch.get_num_threads()} threads")
    print(f"preparing a lift of {len(views)} views by the preset {preset.name} ...", flush=True)
    facts = profile_lift(views, scene.classes, preset)
    print("{anchors} anchors, {visible_anchors} visible in a view; {gaussians} Gaussians drawn".format(**facts))
    for name, milliseconds in facts["parts_ms"].items():
        print(f"{name:20s} {milliseconds:8.1f} ms")
    print(f"{'whole step':20s} {facts['step_ms']:8.1f} ms, {facts['core_ms']:.1f} ms of processor time")
    frame = facts["draw_ms"] + facts["decide_ms"]
    print(
        f"panoptic frame: drawn {facts['draw_ms']:.1f} ms, decided {facts['decide_ms']:.1f} ms: "
        f"{1e3 / frame:.1f} a second (at least 10)"
    )
    print(f"peak memory, with the preparation: {(facts['peak_bytes'] or 0) / 1e9:.1f} GB")
    return facts


def profile_lift(views: Sequence[View], classes: ClassTable, preset: Preset, steps: int = STEPS) -> dict[str, Any]:
    """Prepare a lift, and measure ``steps`` steps with labels, as steps without labels have fewer parts. The first step
    measured is the one at which the statistics of growth begin, which are another part.

    Returns facts for JSON: the numbers of visible anchors and of Gaussians are means over the steps; ``core_ms`` is a
    step's processor time, of all cores together; ``draw_ms`` and ``decide_ms`` are the parts of a panoptic frame."""
    preset = replace(preset, label_every=1)
    prepared = _prepared(views, classes, preset)
    trainer = Trainer(prepared.scene, prepared.targets, list(views), preset, seed=0)
    trainer.step_number = round(Trainer.growth_schedule.statistics_from * preset.steps) + 1
    print(f"{len(prepared.scene.anchors)} anchors; {WARM_UP_STEPS} steps to warm up ...", flush=True)
    for _ in range(WARM_UP_STEPS):
        trainer.step()
    clock, began = MeasuringClock(), time.process_time()
    trainer.clock = clock
    reports = [trainer.step() for _ in range(steps)]
    cores = 1e3 * (time.process_time() - began) / steps
    anchors = trainer.scene.anchors
    draw, decided = _frame_times(prepared, trainer, views, classes, steps)
    parts = typical(clock.steps)
    return {
        "threads": torch.get_num_threads(),
        "anchors": len(anchors),
        "visible_anchors": round(np.mean([len(visible_anchors(anchors, view.camera)) for view in views])),
        "gaussians": round(np.mean([report.gaussians for report in reports])),
        "step_ms": sum(parts.values()),
        "core_ms": cores,
        "peak_bytes": peak_bytes(),
        "parts_ms": parts,
        "draw_ms": draw,
        "decide_ms": decided,
    }


def _prepared(views: Sequence[View], classes: ClassTable, preset: Preset) -> PreparedLift:
    with TemporaryDirectory() as folder:
        events = EventWriter(Path(folder) / "events.jsonl")
        try:
            stages = StageReporter(events, StopSignal(Path(folder) / "cancel"), STAGES)
            return prepare(ViewsToLift(views, classes, preset), stages)
        finally:
            events.close()


def typical(steps: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean milliseconds of each part over the middle half of the steps, sorted by their whole time. This is
    as robust against a disturbed step as a median, and the parts add up to the whole. Raises ValueError for none."""
    if not steps:
        raise ValueError("no steps to report")
    ordered = sorted(steps, key=lambda parts: sum(parts.values()))
    cut = len(ordered) // 4
    middle = ordered[cut : len(ordered) - cut]
    return {name: 1e3 * float(np.mean([parts.get(name, 0.0) for parts in middle])) for name in steps[0]}


def _frame_times(
    prepared: PreparedLift, trainer: Trainer, views: Sequence[View], classes: ClassTable, frames: int
) -> tuple[float, float]:
    """Return the median milliseconds of drawing a panoptic frame, and of deciding its labels."""
    seconds = []
    labels = scene_labels(trainer.scene)
    for view in [views[0], *islice(cycle(views), frames)]:  # the first picture only warms up
        began = time.perf_counter()
        rendering = render_view(trainer.scene, view.camera, labels)
        drawn = time.perf_counter()
        decide(rendering, classes, prepared.class_of_instance)
        seconds.append((drawn - began, time.perf_counter() - drawn))
    draw, decided = np.median(seconds[1:], axis=0)
    return 1e3 * float(draw), 1e3 * float(decided)
