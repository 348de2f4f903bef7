"""What a batch has to do: one job per scene, and which of them an earlier batch did."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from ..errors import PlgsError
from ..job import LiftRequest, write_atomically
from ..job.manifest import check_sizes
from ..json_file import Json, read_object

RECORDS = ".batch"
"""The folder in OUT that records for each scene what was done, and from which result."""


@dataclass(frozen=True)
class SceneJob:
    """A scene to lift into ``lift``. ``problem``: why this is impossible; ``gigabytes``: the memory that the lift is
    predicted to need."""

    name: str
    lift: Path
    request: LiftRequest
    gigabytes: float = 1.0
    problem: str = ""


@dataclass(frozen=True)
class BatchPlan:
    """``chunk`` frames are baked as one piece; 0: only what the lift itself bakes. ``exports`` are forms of export."""

    output: Path
    jobs: tuple[SceneJob, ...]
    chunk: int = 0
    exports: tuple[str, ...] = ()

    def asked(self, job: SceneJob) -> str:
        """A name for what is requested for a scene."""
        about = {"request": job.request.to_json(job.lift), "bakes": bool(self.chunk), "exports": sorted(self.exports)}
        return hashlib.sha256(json.dumps(about, sort_keys=True, default=str).encode()).hexdigest()


@dataclass(frozen=True)
class Row:
    """A scene's row of the table; ``metrics`` are the lift's own, in the mode ``strict``."""

    scene: str
    state: str
    seconds: float
    reason: str
    exit_code: int
    metrics: Mapping[str, Json]


def names_of(scenes: Sequence[Path]) -> list[str]:
    """A name for each scene: that of its folder or file. Raises PlgsError for a scene that is given twice, for two with
    the same name (also in different case, as some disks ignore it), and for a name that no folder can have ("...zip").
    """
    names = [scene.resolve().name if scene.is_dir() else scene.stem for scene in scenes]
    folded = [name.casefold() for name in names]
    places = [scene.resolve() for scene in scenes]
    for name, scene, place in zip(names, scenes, places, strict=True):
        if places.count(place) > 1:
            raise PlgsError("the scene is given twice", scene, "Name it once.")
        if name.strip(". ") == "":
            raise PlgsError("no folder can have this scene's name", scene, "Rename the scene.")
        if folded.count(name.casefold()) > 1 or name.casefold() in (RECORDS, "table.csv", "table.md"):
            raise PlgsError(f"two scenes, or files of the batch, are named {name!r}", scene, "Rename the scene.")
    return names


def done_before(plan: BatchPlan, job: SceneJob) -> Row | None:
    """The row of an earlier batch with the same request, if its result is still the one on disk, with all its files and
    the exports."""
    path = _record(plan, job)
    if not path.is_file():
        return None
    try:
        told = read_object(path, "Delete it: the batch then checks the lift itself.")
        row = told["row"]
        assert isinstance(row, dict)
        is_same = told["asked"] == plan.asked(job) and told["result"] == _result(job)
        check_sizes(job.lift / "result")
        is_same = is_same and all((job.lift / "exports" / form).exists() for form in plan.exports)
        return Row(**row) if is_same and row["state"] == "done" else None  # type: ignore[arg-type]
    except (PlgsError, KeyError, TypeError, AssertionError):
        return None  # damaged: the pieces find out what is done


def remember(plan: BatchPlan, job: SceneJob, row: Row) -> None:
    """Record a row for the next batch. Raises OSError."""
    _record(plan, job).parent.mkdir(exist_ok=True)
    told = {"asked": plan.asked(job), "result": _result(job), "row": asdict(row)}
    write_atomically(_record(plan, job), json.dumps(told, indent=1) + "\n")


def _record(plan: BatchPlan, job: SceneJob) -> Path:
    return plan.output / RECORDS / f"{job.name}.json"


def _result(job: SceneJob) -> str:
    """A name for the result on disk and its corrections; empty without a result."""
    files = [job.lift / "result" / "manifest.json", job.lift / "corrections.json"]
    there = [path.read_bytes() for path in files if path.is_file()]
    return hashlib.sha256(b"\n".join(there)).hexdigest() if files[0].is_file() else ""
