"""Compile what a lift runs, so that the first one starts at once: a lift of a wall, too small to be of use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ..job import EventWriter, StopSignal
from ..model.label_voting import LabelVotes, contributors, pixel_labels
from ..model.render import render_bands
from ..passes import ShownInstances, bake_view
from ..scene import Camera, Category, ClassTable, PanopticMask, Segment, View
from ..train.presets import PRESETS, Schedule, WarmStart
from ..train.progress import StageReporter
from ..train.trainer import Trainer
from .preparation import prepare
from .run import STAGES

WALL, PICTURE = 1, 2
"""Class ids; the picture is a thing."""


def warm_up() -> None:
    """Take every compiled path of a lift once: consistency, matching, projection, rendering and gradients, baking."""
    classes = ClassTable(
        (Category(WALL, "wall", False, (200, 200, 200)), Category(PICTURE, "picture", True, (200, 0, 0)))
    )
    views = [_view_of_a_wall(number) for number in range(3)]
    whole = Schedule(statistics_from=0.0)  # two steps are too few to count anything else
    preset = replace(PRESETS["preview"], steps=2, neighbours=2, warm_start=WarmStart(steps=1), schedule=whole)
    with TemporaryDirectory() as folder:
        events = EventWriter(Path(folder) / "events.jsonl")
        stages = StageReporter(events, StopSignal(Path(folder) / "cancel"), STAGES)
        prepared = prepare(views, classes, preset, 0, stages)
        trainer = Trainer(prepared.scene, prepared.targets, views, preset, 0)
        while not trainer.finished:
            trainer.step()
        camera, shown = views[0].camera, ShownInstances({}, prepared.class_of_instance)
        bake_view(render_bands(trainer.scene, camera), camera, classes, shown)
        votes = LabelVotes(trainer.scene, preset.voting)
        seen = contributors(trainer.scene, views[0].camera, preset.voting.contributors)
        votes.add(seen, np.zeros(views[0].depth.shape, np.int16), views[0].depth)
        pixel_labels(trainer.scene, votes.result(), seen)
        events.close()


def _view_of_a_wall(number: int) -> View:
    """A wall a metre away, with a picture on its right half."""
    width, height = 48, 32
    pose = np.eye(4)
    pose[0, 3] = 0.05 * number
    camera = Camera(width, height, 40.0, 40.0, width / 2, height / 2, pose)
    ids = np.full((height, width), WALL, np.int32)
    ids[:, width // 2 :] = PICTURE
    segments = (Segment(WALL, WALL, False), Segment(PICTURE, PICTURE, True))
    colour = np.full((height, width, 3), 128, np.uint8)
    return View(f"{number}", camera, colour, np.ones((height, width), np.float32), PanopticMask(ids, segments))
