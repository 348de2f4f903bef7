"""Compiles everything that a lift runs, by lifting a tiny wall, so that the first real lift starts at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from ..job import EventWriter, StopSignal
from ..job.progress import StageReporter
from ..model.gaussians import decode
from ..model.label_voting import LabelVotes, contributors, pixel_labels
from ..model.neural_gaussians import PanopticRendering
from ..model.render import render_bands
from ..model.structured import LabelChannels
from ..passes.baked_view import ShownInstances, bake_view
from ..presets.preset import PRESETS
from ..raster import rasterize
from ..scene import Camera, Category, ClassTable, PanopticMask, Segment, View
from ..train.trainer import GrowthSchedule, Trainer, reconstruction_loss
from .preparation import ViewsToLift, prepare
from .run import STAGES

WALL, PICTURE = 1, 2
"""Class ids; the picture is a thing."""


class _Trainer(Trainer):
    growth_schedule = GrowthSchedule(statistics_from=0.0)  # with only two steps, statistics must start at once


def warm_up() -> None:
    """Run every compiled function of a lift once. Numba compiles one function at a time, so a second process compiles
    the rasteriser, which is half of the work, and leaves it in the cache."""
    rasteriser = get_context("spawn").Process(target=compile_rasteriser)
    rasteriser.start()
    try:
        lift_a_wall(rasteriser.join)
    finally:
        rasteriser.join()


def compile_rasteriser() -> None:
    """Compile the rasteriser: render with and without labels, and backpropagate."""
    random = np.random.default_rng(0)
    widths = {"means": 3, "scales": 3, "quats": 4, "colours": 3, "labels": 4}
    drawn = {name: random.uniform(0.05, 0.3, (200, width)).astype(np.float32) for name, width in widths.items()}
    means, scales, quats, colours, labels = (torch.from_numpy(array).requires_grad_() for array in drawn.values())
    opacities = torch.full((200,), 0.5, requires_grad=True)
    lens = np.array([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]])
    pose = np.eye(4)
    pose[2, 3] = -1.0
    for shown in (labels, None):
        look = (pose, lens, 64, 48)
        picture = rasterize(means, scales, quats, opacities, colours, shown, *look, top_k=1, want_surface=True)
        picture.image.sum().backward()


def lift_a_wall(wait_for_rasteriser: Callable[[], object]) -> None:
    """Check, match, prepare, train and bake an invented scene. Training begins when ``wait_for_rasteriser`` returns."""
    classes = ClassTable(
        (Category(WALL, "wall", False, (200, 200, 200)), Category(PICTURE, "picture", True, (200, 0, 0)))
    )
    views = [_view_of_a_wall(number) for number in range(3)]
    preset = replace(PRESETS["preview"], steps=2, neighbours=2, warm_start=False)
    with TemporaryDirectory() as folder:
        events = EventWriter(Path(folder) / "events.jsonl")
        stages = StageReporter(events, StopSignal(Path(folder) / "cancel"), STAGES)
        prepared = prepare(ViewsToLift(views, classes, preset), stages)
        trainer = _Trainer(prepared.scene, prepared.targets, views, preset, 0)
        camera, shown = views[0].camera, ShownInstances({}, prepared.class_of_instance)
        gaussians = decode(trainer.scene.anchors, trainer.scene.decoders, camera, channels=trainer.initial_channels)
        image = torch.zeros(camera.height, camera.width, 3, requires_grad=True)
        loss = reconstruction_loss(
            image, trainer.targets[0].photo, gaussians.scales, photo_weight=1.0, ssim_weight=0.2, volume_weight=0.001
        )
        loss.backward()
        bake_view([_nothing_rendered(camera, prepared.scene.channels)], camera, classes, shown)
        wait_for_rasteriser()  # the steps need it
        while not trainer.finished:
            trainer.step()
        bake_view(render_bands(trainer.scene, camera), camera, classes, shown)
        votes = LabelVotes(trainer.scene, preset.evidence.gaussians)
        seen = contributors(trainer.scene, views[0].camera)
        votes.add(seen, np.zeros(views[0].depth.shape, np.int16), views[0].depth)
        pixel_labels(trainer.scene, votes.result(), seen)
        events.close()


def _nothing_rendered(camera: Camera, channels: LabelChannels) -> PanopticRendering:
    size, labels = (camera.height, camera.width), len(channels.class_ids)
    coverage = np.zeros((*size, labels + len(channels.shown_ids)), np.float32)
    return PanopticRendering(
        camera,
        image=np.zeros((*size, 3), np.float32),
        alpha=np.zeros(size, np.float32),
        depth=np.zeros(size, np.float32),
        class_coverage=coverage[..., :labels],
        instance_coverage=coverage[..., labels:],
        class_ids=channels.class_ids,
        instance_ids=channels.shown_ids,
    )


def _view_of_a_wall(number: int) -> View:
    """Return an invented view of a wall a metre away, with a picture hanging on its right half."""
    width, height = 48, 32
    pose = np.eye(4)
    pose[0, 3] = 0.05 * number
    camera = Camera(width, height, 40.0, 40.0, width / 2, height / 2, pose)
    ids = np.full((height, width), WALL, np.int32)
    ids[:, width // 2 :] = PICTURE
    segments = (Segment(WALL, WALL, False), Segment(PICTURE, PICTURE, True))
    colour = np.full((height, width, 3), 128, np.uint8)
    return View(f"{number}", camera, colour, np.ones((height, width), np.float32), PanopticMask(ids, segments))
