"""results.json: the figures of one call, to be compared with those of a later one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ..job import JobError
from ..job.json_file import Json, read_object, to_text
from .figures import METHODS, Figures, SceneResult, number

FORMAT = 1
_FIX = "Give a results.json that this command wrote."


def results_text(results: Sequence[SceneResult]) -> str:
    """The text of results.json: shares in [0, 1], decibels, metres, seconds, null where nothing was measured."""
    return to_text({"format": FORMAT, "results": [_to_json(result) for result in results]})


def read_results(path: Path) -> tuple[SceneResult, ...]:
    """What `results_text` wrote. Raises JobError when the file holds something else."""
    content = read_object(path, _FIX)
    if content.get("format") != FORMAT:
        what = f"has format {content.get('format')!r}, this version reads {FORMAT}"
        raise JobError(what, path, _FIX)
    try:
        results = tuple(_from_json(entry) for entry in _objects(content["results"]))
    except (KeyError, TypeError, ValueError) as error:
        raise JobError(f"is damaged ({error!r})", path, _FIX) from error
    if not results:
        raise JobError("holds no results", path, _FIX)
    return results


def _to_json(result: SceneResult) -> dict[str, object]:
    rows = [{"method": method, **figures._asdict()} for method, figures in result.rows.items()]
    return {**vars(result), "rows": rows}


def _from_json(entry: Mapping[str, Json]) -> SceneResult:
    """Raises KeyError, TypeError or ValueError when something is missing or of another type."""
    steps, seed = entry["steps"], entry["seed"]
    if not isinstance(steps, int) or not isinstance(seed, int):
        raise TypeError("steps or seed is no whole number")
    rows = {str(row["method"]): _figures(row) for row in _objects(entry["rows"])}
    if not rows.keys() <= set(METHODS):
        raise ValueError(f"unknown methods among {', '.join(rows)}")
    text = {key: str(entry[key]) for key in ("scene", "preset", "engine_version")}
    return SceneResult(**text, steps=steps, seed=seed, rows=rows)


def _figures(row: Mapping[str, Json]) -> Figures:
    return Figures(**{key: number(row.get(key)) for key in Figures._fields})


def _objects(value: Json) -> list[dict[str, Json]]:
    """Raises TypeError when it is no list of objects."""
    entries = value if isinstance(value, list) else [value]
    objects = [entry for entry in entries if isinstance(entry, dict)]
    if not isinstance(value, list) or len(objects) != len(entries):
        raise TypeError("a list of objects is missing")
    return objects
