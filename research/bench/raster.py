"""``python -m research bench raster``: milliseconds of each stage."""

from __future__ import annotations

import platform
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from engine.machine.threads import timed
from engine.raster.interface import rasterize

from .room import CHANNELS, Workload, room_workload

CASES = ((10_000, 640, 480), (50_000, 640, 480), (200_000, 640, 480), (5_000, 160, 120))
STAGES = {
    "project": "projection",
    "count_tiles": "binning",
    "scatter_tiles": "binning",
    "blend_forward": "blend forward",
    "blend_backward": "blend backward",
    "gather": "gather",
}


def bench_raster(repeats: int = 9) -> dict[str, Any]:
    """Print a table of medians over ``repeats`` (after one warm-up), and return its rows with what they were measured
    on.

    All times are milliseconds of wall time, whole passes from 3D parameters, except ``processor``, which is the
    processor time of a whole step (least of the repeats). ``GFLOP/s`` counts two operations for every label of every
    blended pair of Gaussian and pixel, over the time of the two blending stages. ``efficiency`` is how much of a
    thread's speed remains when all run: the least time with one thread over ``threads`` times the least with all.
    """
    threads = torch.get_num_threads()
    print(f"{processor_name()}, {threads} threads")
    print("Gaussians      size  channels  forward  backward   total  processor  GFLOP/s  efficiency  stages")
    rows = []
    for count, width, height in CASES:
        workload = room_workload(count, width, height)
        pairs = blended_pairs(workload)
        for channels in (0, CHANNELS):
            row = measure(workload, channels, repeats, pairs)
            row["efficiency"] = efficiency(workload, channels, repeats, threads)
            row.update(gaussians=count, width=width, height=height, channels=channels + 3)
            rows.append(row)
            stages = ", ".join(f"{name} {value:.1f}" for name, value in row["stages"].items())
            print(
                f"{count:9d} {width:5d}x{height:<4d} {channels + 3:7d} {row['forward']:8.1f} {row['backward']:9.1f} "
                f"{row['total']:7.1f} {row['processor']:10.1f} {row['gflops']:8.1f} {row['efficiency']:11.0%}  "
                f"{stages}",
                flush=True,
            )
    return {"cpu": processor_name(), "threads": threads, "rows": rows}


def measure(workload: Workload, channels: int, repeats: int, pairs: int) -> dict[str, Any]:
    """Median milliseconds of forward, backward and total, least milliseconds of the total, least processor
    milliseconds, stages of the median run."""
    labels = workload.labels[:, :channels].copy() if channels else None
    random = np.random.default_rng(1234)
    shape = (workload.height, workload.width)
    d_image = torch.from_numpy(random.standard_normal((*shape, 3), dtype=np.float32))
    d_labels = torch.from_numpy(random.standard_normal((*shape, channels), dtype=np.float32))
    runs = []
    for _ in range(repeats + 1):
        arrays = (*workload.gaussians, labels)
        inputs = [None if array is None else torch.from_numpy(array).requires_grad_() for array in arrays]
        processor, start = time.process_time(), time.perf_counter()
        with timed() as stages:
            out = rasterize(*inputs, *workload.view)  # type: ignore[call-arg, arg-type]
            middle = time.perf_counter()
            layers = [out.image] if out.labels is None else [out.image, out.labels]
            torch.autograd.backward(layers, [d_image, d_labels][: len(layers)])
        end = time.perf_counter()
        runs.append((end - start, middle - start, end - middle, time.process_time() - processor, stages))
        del out, layers
    runs = sorted(runs[1:], key=lambda run: run[0])
    total, forward, backward, _, stages = runs[len(runs) // 2]
    grouped: dict[str, float] = {}
    for name, seconds in stages.items():
        grouped[STAGES[name]] = grouped.get(STAGES[name], 0.0) + seconds * 1e3
    blending = (grouped["blend forward"] + grouped["blend backward"]) * 1e-3
    return {
        "forward": forward * 1e3,
        "backward": backward * 1e3,
        "total": total * 1e3,
        "least": runs[0][0] * 1e3,
        "processor": min(run[3] for run in runs) * 1e3,
        "gflops": 4.0 * channels * pairs / blending / 1e9,
        "stages": grouped,
    }


def efficiency(workload: Workload, channels: int, repeats: int, threads: int) -> float:
    """Least time with one thread over ``threads`` times the least with all of them, measured in turns."""
    alone, together = [], []
    try:
        for _ in range(-(-repeats // 3)):
            torch.set_num_threads(1)
            alone.append(measure(workload, channels, 2, 0)["least"])
            torch.set_num_threads(threads)
            together.append(measure(workload, channels, 2, 0)["least"])
    finally:
        torch.set_num_threads(threads)
    return min(alone) / (threads * min(together))


def blended_pairs(workload: Workload) -> int:
    """How many pairs of Gaussian and pixel are blended: the sum over Gaussians of the pixels that see
    them."""
    gaussians = (torch.from_numpy(array) for array in workload.gaussians)
    out = rasterize(*gaussians, None, *workload.view, top_k=PAIRS_COUNTED)  # type: ignore[call-arg, arg-type, misc]
    assert out.top_indices is not None
    return int((out.top_indices >= 0).sum())


PAIRS_COUNTED = 128
"""Gaussians of a pixel that are counted at most; no pixel of the workload sees more."""


def processor_name() -> str:
    """The processor's name, as the system gives it."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
