"""The figures of a finished lift: out of its metrics.json, and its time and memory out of its events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ..job import Event, EventReader, LiftFolder, read_manifest
from ..job.json_file import Json, read_object
from ..metrics import LIFTED


class Figures(NamedTuple):
    """What was measured of a row: shares in [0, 1], decibels, metres, seconds; None where something was not.

    ``miou`` and ``pq`` are of the mode ``strict``; ``pq_frame`` is PQ frame by frame, ``id_changes`` how often an
    object changes its id over the held-out frames; ``psnr_fitted`` is PSNR after a fit of the colours; ``fps`` panoptic
    frames a second, drawn and decided at the frames' own size.
    """

    miou: float | None = None
    pq: float | None = None
    miou_pl_compat: float | None = None
    pq_pl_compat: float | None = None
    pq_frame: float | None = None
    id_changes: float | None = None
    psnr: float | None = None
    psnr_fitted: float | None = None
    ssim: float | None = None
    depth_error_m: float | None = None
    seconds: float | None = None
    peak_bytes: float | None = None
    fps: float | None = None


@dataclass(frozen=True)
class Result:
    """What was measured of one row on one scene; ``steps`` 0 where nothing was trained."""

    scene: str
    row: str
    preset: str
    steps: int
    seed: int
    engine_version: str
    figures: Figures

    @property
    def key(self) -> tuple[str, str, str, int]:
        """What it is a result of."""
        return self.scene, self.row, self.preset, self.seed


def read_result(scene: str, row: str, preset: str, lift: LiftFolder) -> Result:
    """The figures of a finished lift. Raises JobError when its files cannot be read."""
    manifest = read_manifest(lift.result_path)
    content = read_object(lift.result_path / "metrics.json", "Delete it: the same command then makes it anew.")
    tables = content.get("tables")
    found = scores_by_method([table for table in tables if isinstance(table, dict)] if isinstance(tables, list) else [])
    events = EventReader(lift.events_path).poll()
    figures = found.get(LIFTED, Figures())._replace(seconds=lifting_seconds(events), **run_figures(events))
    steps = int(number(manifest.settings.get("steps")) or 0)
    return Result(scene, row, preset, steps, manifest.seed, manifest.engine_version, figures)


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
            followed = {key: number(table.get(key)) for key in ("pq_frame", "id_changes")}
            figures = figures._replace(miou=labels[0], pq=labels[1], **followed)
        rows[method] = figures._replace(**rendered)
    return rows


def run_figures(events: Sequence[Event]) -> dict[str, float | None]:
    """Memory and frames a second that a lift's last run told of; the most memory of all its runs."""
    told = [event.data["values"] for event in events if event.kind == "metric" and event.data.get("name") == "run"]
    values = [each for each in told if isinstance(each, dict)]
    peaks = [peak for each in values if (peak := number(each.get("peak_bytes"))) is not None]
    return {"peak_bytes": max(peaks, default=None), "fps": number(values[-1].get("fps")) if values else None}


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
