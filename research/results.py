"""Read the results of finished lifts, and write them to results.json and results.csv."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from engine import __version__
from engine.gates import table_cell
from engine.job import Event, EventReader, LiftFolder, read_manifest
from engine.json_file import Json, read_object, to_text
from engine.machine.code_digest import code_digest
from engine.metrics.report import LIFTED

SOURCES = ("engine", "research/baselines")
"""The folders whose code makes the figures."""


class Figures(NamedTuple):
    """The figures of a row: shares in [0, 1], decibels, metres, seconds; None if something was not measured.

    ``miou``, ``miou_true`` (over the classes that the ground truth has) and ``pq`` are of the mode ``strict``;
    ``pq_frame`` is PQ frame by frame, ``id_changes`` how often an object changes its id over the held-out frames;
    ``psnr_fitted`` is PSNR after a fit of the colours; ``fps`` is panoptic frames per second, drawn and decided at the
    frames' own size."""

    miou: float | None = None
    miou_true: float | None = None
    pq: float | None = None
    miou_pl_compat: float | None = None
    miou_true_pl_compat: float | None = None
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
    """The figures of one row on one scene; ``steps`` is 0 if nothing was trained. ``engine_version`` includes the
    digest of the code, like `this_engine`. ``failed`` says why there are no figures, "" if there are."""

    scene: str
    row: str
    preset: str
    steps: int
    seed: int
    engine_version: str
    figures: Figures = Figures()
    failed: str = ""


def read_result(scene: str, row: str, preset: str, lift: LiftFolder) -> Result:
    """Return the figures of a finished lift, for a row on a scene. Raises PlgsError if its files cannot be read."""
    manifest = read_manifest(lift.result_path)
    content = read_object(lift.result_path / "metrics.json", "Delete it: the same command then makes it again.")
    tables = content.get("tables")
    found = scores_by_method([table for table in tables if isinstance(table, dict)] if isinstance(tables, list) else [])
    events = EventReader(lift.events_path).poll()
    figures = found.get(LIFTED, Figures())._replace(seconds=lifting_seconds(events), **run_figures(events))
    steps = int(number(manifest.settings.get("steps")) or 0)
    version = f"{manifest.engine_version} {manifest.versions.get('code', '')}".strip()
    return Result(scene, row, preset, steps, manifest.seed, version, figures)


def this_engine() -> str:
    """Return the version of the running engine, with the digest of its code, such as "0.1.0 1a2b3c4d"."""
    return f"{__version__} {code_digest(*SOURCES)}"


def scores_by_method(tables: Sequence[Mapping[str, Json]]) -> dict[str, Figures]:
    """Return the figures in the tables of metrics.json, by method. A table without a mode has no scores of labels."""
    rows: dict[str, Figures] = {}
    for table in tables:
        method = str(table.get("name"))
        figures = rows.get(method, Figures())
        rendered = {key: number(table.get(key)) for key in ("psnr", "psnr_fitted", "ssim", "depth_error_m")}
        labels = {key: number(table.get(key)) for key in ("miou", "miou_true", "pq")}
        if table.get("mode") == "pl_compat":
            figures = figures._replace(**{f"{key}_pl_compat": value for key, value in labels.items()})
        else:
            followed = {key: number(table.get(key)) for key in ("pq_frame", "id_changes")}
            figures = figures._replace(**labels, **followed)
        rows[method] = figures._replace(**rendered)
    return rows


def run_figures(events: Sequence[Event]) -> dict[str, float | None]:
    """Return frames per second of a lift's last run, and the peak memory of all its runs."""
    reported = [event.data["values"] for event in events if event.kind == "metric" and event.data.get("name") == "run"]
    values = [each for each in reported if isinstance(each, dict)]
    peaks = [peak for each in values if (peak := number(each.get("peak_bytes"))) is not None]
    return {"peak_bytes": max(peaks, default=None), "fps": number(values[-1].get("fps")) if values else None}


def lifting_seconds(events: Sequence[Event]) -> float | None:
    """Return how long a lift took, all its runs together; None if it never ran. A run counts from its beginning until
    the held-out frames are drawn: drawing and scoring them does not belong to a lift."""
    runs: list[list[Event]] = []
    for event in events:
        if event.kind == "hello":
            runs.append([])
        if runs:
            runs[-1].append(event)
    lifts = [run for run in runs if run[0].data.get("task", "lift") == "lift"]  # other runs baked passes after the lift
    seconds = 0.0
    for run in lifts:
        ends = (event for event in run if event.kind == "stage" and event.data["name"] == "bake")
        seconds += next(ends, run[-1]).time - run[0].time
    return round(seconds, 1) if lifts else None


def number(value: Json) -> float | None:
    """Return the number, or None for anything else."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def results_text(results: Sequence[Result]) -> str:
    """Return the text of results.json: shares in [0, 1], decibels, metres, seconds, null if nothing was measured."""
    entries = [{**vars(result), "figures": result.figures._asdict()} for result in results]
    return to_text({"format": 2, "results": entries})


def csv_text(results: Sequence[Result]) -> str:
    """Return the text of results.csv: one line per result, with the same figures; empty where nothing was measured."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*(name for name in vars(results[0]) if name != "figures"), *Figures._fields] if results else [])
    for result in results:
        row = [*(value for name, value in vars(result).items() if name != "figures"), *result.figures]
        writer.writerow([table_cell(cell) for cell in row])
    return out.getvalue()
