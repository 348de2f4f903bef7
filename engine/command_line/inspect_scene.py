"""``inspect``: what is in a scene."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from ..job import ExitCode
from ..job.effort import chosen_effort
from ..job.prediction import machine_slowness, predict
from ..scene import SceneReport, Size, UpAxis, describe, open_scene


def inspect_scene(
    folder: Path,
    masks: Path | None,
    up: UpAxis,
    *,
    scene_format: str | None = None,
    depth: Path | None = None,
    mask_format: str | None = None,
    classes: str | None = None,
    as_json: bool = False,
    preset: str | None = None,
) -> ExitCode:
    """Decode every frame and print what is there, for people or as one line of JSON. For people also what a lift with
    ``preset`` would take.

    Raises SceneError for the first thing that is wrong.
    """
    report = describe(open_scene(folder, masks, up, scene_format, depth, mask_format, classes))
    if as_json:
        print(json.dumps(asdict(report), default=str))
    else:
        print(*_lines(report), sep="\n")
        if preset is not None:
            print(_prediction(report, preset))
    return ExitCode.FINISHED


def _lines(report: SceneReport) -> Iterator[str]:
    yield f"scene     {report.folder}"
    yield f"format    {report.format}"
    yield f"frames    {report.train_frames} for training, {report.test_frames} held out"
    yield f"truth     {report.ground_truth_frames or 'no'} frames"
    yield f"colour    {_sizes(report.colour_sizes)}"
    if report.depth_range is None:
        yield "depth     none: a lift is not possible"
    else:
        near, middle, far = report.depth_range
        yield f"depth     {_sizes(report.depth_sizes)}, {near:.2f} to {far:.2f} m, half within {middle:.2f} m"
    if report.segments_per_frame is None:
        yield "masks     none: a lift is not possible"
    else:
        fewest, median, most = report.segments_per_frame
        yield f"masks     {_sizes(report.mask_sizes)}, {fewest} to {most} segments a frame, {median} in the middle"
    if report.sparse_points:
        yield f"points    {report.sparse_points} of the reconstruction"
    yield "cameras   within " + " x ".join(f"{side:.2f}" for side in report.extent) + " m"
    if report.classes:
        yield f"classes   {len(report.classes)}, {report.void_share:.1%} of the pixels without"
    for entry in sorted(report.classes, key=lambda entry: -entry.share):
        yield f"  {entry.id:4d}  {entry.name:<24} {'thing' if entry.is_thing else 'stuff'} {entry.share:7.1%}"
    for warning in report.warnings:
        yield f"warning: {warning}"


def _prediction(report: SceneReport, preset: str) -> str:
    """Such as "preview   about 3 min and 1.0 GB of memory"."""
    size, effort, slowness = report.colour_sizes[0][0], chosen_effort(preset), machine_slowness()
    lift = predict(report.train_frames, report.test_frames, size, effort, slowness=slowness)
    minutes = lift.seconds / 60
    time = f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
    return f"{preset:<9} about {time} and {lift.peak_bytes / 1e9:.1f} GB of memory"


def _sizes(sizes: tuple[tuple[Size, int], ...]) -> str:
    """Such as "640x480", or "640x480 (30), 320x240 (2)"."""
    if len(sizes) == 1:
        return "{}x{}".format(*sizes[0][0])
    return ", ".join(f"{width}x{height} ({count})" for (width, height), count in sizes)
