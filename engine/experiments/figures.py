"""The figures of a finished lift: out of its metrics.json, and its time out of its events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ..job import Event, EventReader, LiftFolder, read_manifest
from ..job.json_file import Json, read_object
from ..metrics import LIFTED, MACHINE_MASKS, VOXEL_VOTE

METHODS = (MACHINE_MASKS, VOXEL_VOTE, LIFTED)
"""In the order of the table's rows."""


class Figures(NamedTuple):
    """A row of the table: shares in [0, 1], decibels, metres, seconds; None where something was not measured.

    ``miou`` and ``pq`` are of the mode ``strict``; ``psnr_fitted`` is PSNR after a fit of the colours.
    """

    miou: float | None = None
    pq: float | None = None
    miou_pl_compat: float | None = None
    pq_pl_compat: float | None = None
    psnr: float | None = None
    psnr_fitted: float | None = None
    ssim: float | None = None
    depth_error_m: float | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class SceneResult:
    """What was measured on one scene. ``rows``: method (METHODS) to its figures; the lifted model has always a row."""

    scene: str
    preset: str
    steps: int
    seed: int
    engine_version: str
    rows: Mapping[str, Figures]


def read_result(scene: str, lift: LiftFolder) -> SceneResult:
    """The figures of a finished lift. Raises JobError when its files cannot be read."""
    manifest = read_manifest(lift.result_path)
    content = read_object(lift.result_path / "metrics.json", "Delete it: the same command then makes it anew.")
    tables = content.get("tables")
    seconds = lifting_seconds(EventReader(lift.events_path).poll())
    rows = scores_by_method([table for table in tables if isinstance(table, dict)] if isinstance(tables, list) else [])
    rows[LIFTED] = rows.get(LIFTED, Figures())._replace(seconds=seconds)
    return SceneResult(
        scene=scene,
        preset=lift.request.preset,
        steps=int(number(manifest.settings.get("steps")) or 0),
        seed=manifest.seed,
        engine_version=manifest.engine_version,
        rows={method: rows[method] for method in METHODS if method in rows},
    )


def scores_by_method(tables: Sequence[Mapping[str, Json]]) -> dict[str, Figures]:
    """Of the tables of metrics.json, one a method and mode; one without a mode has no labels scored."""
    rows: dict[str, Figures] = {}
    for table in tables:
        method = str(table.get("name"))
        figures = rows.get(method, Figures())
        rendered = {key: number(table.get(key)) for key in ("psnr", "psnr_fitted", "ssim", "depth_error_m")}
        labels = number(table.get("miou")), number(table.get("pq"))
        if table.get("mode") == "pl_compat":
            figures = figures._replace(miou_pl_compat=labels[0], pq_pl_compat=labels[1])
        else:
            figures = figures._replace(miou=labels[0], pq=labels[1])
        rows[method] = figures._replace(**rendered)
    return rows


def lifting_seconds(events: Sequence[Event]) -> float | None:
    """How long a lift took, all its runs together; None when there was none.

    From the beginning of a run until the held-out frames are drawn: drawing and scoring them is no part of a lift.
    """
    runs: list[list[Event]] = []
    for event in events:
        if event.kind == "hello":
            runs.append([])
        if runs:
            runs[-1].append(event)
    lifts = [run for run in runs if "task" not in run[0].data]  # the others baked more frames afterwards
    return round(sum(_seconds_of_run(run) for run in lifts), 1) if lifts else None


def _seconds_of_run(run: Sequence[Event]) -> float:
    ends = (event for event in run if event.kind == "stage" and event.data["name"] == "bake")
    return next(ends, run[-1]).time - run[0].time


def number(value: Json) -> float | None:
    """None for what is none."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
