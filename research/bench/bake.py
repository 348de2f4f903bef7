"""``python -m research bench bake``: milliseconds of each part of a baked frame, and the memory it takes."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from engine.job.system import peak_bytes
from engine.model.neural_gaussians import NeuralGaussians
from engine.model.render import MOST_BYTES, draw_bands
from engine.model.rendering import ClipRange, PanopticRendering
from engine.model.scene_labels import VotedLabels
from engine.model.structured import GaussianLabels, LabelChannels
from engine.passes.baked_view import ShownInstances, bake_view
from engine.passes.exr import write_exr
from engine.passes.previews import write_previews
from engine.scene import Camera, Category, ClassTable

from .raster import processor_name
from .room import Workload, room_workload

CASES = ((640, 480, 22, 48), (1296, 968, 22, 48), (1296, 968, 200, 300))
"""Width, height, classes, instances."""
GAUSSIANS = 200_000
LABELS = 4
"""Labels of each Gaussian."""
PARTS = ("draw", "decide", "EXR", "previews")
"""To decide is also to rank the mattes, and to fit the surface."""
PROCESSOR = "processor"


@dataclass(frozen=True, eq=False)
class Room:
    """Gaussians of a furnished room with labels, and who sees them."""

    drawn: NeuralGaussians
    labels: VotedLabels
    channels: LabelChannels
    camera: Camera
    classes: ClassTable
    instances: ShownInstances

    def bands(self) -> Iterator[PanopticRendering]:
        rows = torch.arange(len(self.drawn.means))
        return draw_bands(self.drawn, rows, self.labels, self.channels, self.camera, ClipRange(), MOST_BYTES)


def bench_bake(repeats: int = 5) -> dict[str, Any]:
    """Print milliseconds of a baked frame by part, the least of ``repeats`` after a first, the processor time of the
    whole, and the most memory held; return the rows. Each case has a process of its own."""
    print(f"{processor_name()}, {torch.get_num_threads()} threads; {GAUSSIANS} Gaussians; ms, the least of {repeats}")
    columns = (*PARTS, "frame", PROCESSOR)
    print(f"{'size':>9s} classes objects {' '.join(f'{name:>9s}' for name in columns)}   peak GB")
    rows = []
    for case in CASES:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as processes:
            row = processes.submit(measure, case, repeats).result()
        size = "{:.0f}x{:.0f}".format(*case)
        times = " ".join(f"{row[name]:9.0f}" for name in columns)
        print(f"{size:>9s} {case[2]:7d} {case[3]:7d} {times} {row['peak_gb']:9.2f}", flush=True)
        rows.append(row)
    return {"cpu": processor_name(), "threads": torch.get_num_threads(), "rows": rows}


def measure(case: tuple[int, int, int, int], repeats: int, gaussians: int = GAUSSIANS) -> dict[str, float]:
    """Least milliseconds of each part, of the whole and of its processor time over ``repeats``, after a first that
    compiles; and the most gigabytes that this process has held."""
    width, height, classes, instances = case
    room = labelled_room(gaussians, width, height, classes, instances)
    best = dict.fromkeys((*PARTS, "frame", PROCESSOR), float("inf"))
    for _ in range(repeats + 1):
        taken = _bake_once(room)
        best = {name: min(best[name], 1e3 * taken[name]) for name in best}
    size = {"width": width, "height": height, "classes": classes, "instances": instances}
    return size | best | {"peak_gb": (peak_bytes() or 0) / 1e9}


def _bake_once(room: Room) -> dict[str, float]:
    """Seconds of each part, of the whole and of the processor."""
    seconds = dict.fromkeys((*PARTS, "frame", PROCESSOR), 0.0)
    processor = time.process_time()
    with TemporaryDirectory() as folder, _clock(seconds, "frame"):
        with _clock(seconds, "decide"):
            view = bake_view(_timed(room.bands(), seconds), room.camera, room.classes, room.instances)
        seconds["decide"] -= seconds["draw"]
        with _clock(seconds, "EXR"):
            write_exr(Path(folder) / "frame.exr", view)
        with _clock(seconds, "previews"):
            write_previews(Path(folder), "frame", view.layers, room.classes, room.instances.colours)
    seconds[PROCESSOR] = time.process_time() - processor
    return seconds


def _timed(bands: Iterator[PanopticRendering], seconds: dict[str, float]) -> Iterator[PanopticRendering]:
    while True:
        with _clock(seconds, "draw"):
            band = next(bands, None)
        if band is None:
            return
        yield band
        del band


@contextmanager
def _clock(seconds: dict[str, float], part: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[part] += time.perf_counter() - began


def labelled_room(count: int, width: int, height: int, classes: int, instances: int) -> Room:
    """The rasteriser's room, cut into cubes: each has a class, or an instance of one, that its Gaussians were voted to
    be, and a few others besides. The first half of the classes is stuff."""
    workload = room_workload(count, width, height)
    meaning = LabelChannels(
        class_ids=tuple(range(1, classes + 1)),
        slot_ids=(*range(1, instances + 1), 0),
        class_of_slot=(*(classes // 2 + 1 + one % (classes - classes // 2) for one in range(instances)), 0),
    )
    table = ClassTable(
        tuple(Category(one, f"class {one}", one > classes // 2, (one % 256, 99, 9)) for one in meaning.class_ids)
    )
    names = {one: f"object {one}" for one in meaning.shown_ids}
    class_of = dict(zip(meaning.slot_ids, meaning.class_of_slot, strict=True))
    lens = workload.intrinsics
    camera = Camera(width, height, lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2], workload.camera_to_world)
    labels = VotedLabels.of_scene(_votes(workload, classes + instances), meaning)
    return Room(_gaussians(workload), labels, meaning, camera, table, ShownInstances(names, class_of))


def _votes(workload: Workload, labels: int) -> GaussianLabels:
    random = np.random.default_rng(3)
    cube = np.floor(workload.means / 0.4).astype(np.int64) @ (1, 31, 977)
    likely = (cube[:, None] * 7919 + np.arange(LABELS) * 104729) % labels
    share = random.dirichlet([20.0, 1.0, 0.3, 0.3], len(cube))
    return GaussianLabels(torch.from_numpy(likely.astype(np.int16)), torch.from_numpy(share.astype(np.float32)))


def _gaussians(workload: Workload) -> NeuralGaussians:
    means, scales, quats, opacities, colours = map(torch.from_numpy, workload.gaussians)
    every = torch.arange(len(means))
    return NeuralGaussians(
        means=means,
        scales=scales,
        quats=quats,
        opacities=opacities,
        colours=colours,
        labels=torch.empty(len(means), 0),
        visible=every,
        all_opacities=opacities[:, None],
        kept=every,
        cluster_loss=torch.zeros(()),
    )
