"""results.json: the figures of one call, to be compared with those of a later one; results.csv, for other programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..job import JobError
from ..job.json_file import Json, read_object, to_text
from .figures import Figures, Result, number

FORMAT = 2
_FIX = "Give a results.json that this command wrote."
_TEXTS = ("scene", "row", "preset", "engine_version")


def results_text(results: Sequence[Result]) -> str:
    """The text of results.json: shares in [0, 1], decibels, metres, seconds, null where nothing was measured."""
    entries = [{**vars(result), "figures": result.figures._asdict()} for result in results]
    return to_text({"format": FORMAT, "results": entries})


def csv_text(results: Sequence[Result]) -> str:
    """The text of results.csv: a line a result, with the same figures; empty where nothing was measured."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*(name for name in vars(results[0]) if name != "figures"), *Figures._fields] if results else [])
    for result in results:
        writer.writerow([*(value for name, value in vars(result).items() if name != "figures"), *result.figures])
    return out.getvalue()


def read_results(path: Path) -> tuple[Result, ...]:
    """What `results_text` wrote. Raises JobError when the file holds something else."""
    content = read_object(path, _FIX)
    if content.get("format") != FORMAT:
        what = f"has format {content.get('format')!r}, this version reads {FORMAT}"
        raise JobError(what, path, _FIX)
    try:
        results = tuple(_from_json(entry) for entry in _objects(content["results"]))
    except (KeyError, TypeError) as error:
        raise JobError(f"is damaged ({error!r})", path, _FIX) from error
    if not results:
        raise JobError("holds no results", path, _FIX)
    return results


def _from_json(entry: Mapping[str, Json]) -> Result:
    """Raises KeyError or TypeError when something is missing or of another type."""
    steps, seed, figures = entry["steps"], entry["seed"], entry["figures"]
    if not isinstance(steps, int) or not isinstance(seed, int) or not isinstance(figures, dict):
        raise TypeError("steps, seed or figures have another type")
    read = Figures(**{key: number(figures.get(key)) for key in Figures._fields})
    return Result(**{key: str(entry[key]) for key in _TEXTS}, steps=steps, seed=seed, figures=read)


def _objects(value: Json) -> list[dict[str, Json]]:
    """Raises TypeError when it is no list of objects."""
    entries = value if isinstance(value, list) else [value]
    objects = [entry for entry in entries if isinstance(entry, dict)]
    if not isinstance(value, list) or len(objects) != len(entries):
        raise TypeError("a list of objects is missing")
    return objects
