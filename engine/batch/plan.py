"""Plan a batch: its jobs, one per scene; which of them an earlier batch did; and the table of results."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import PlgsError
from ..gates import inner_path, markdown_cell, table_cell
from ..job import LiftRequest, write_atomically
from ..job.manifest import check_sizes, read_manifest
from ..job.own_files import OwnFiles
from ..json_file import Json, read_object

RECORDS = ".batch"
"""The folder in OUT that records for each scene what was done, and from which result."""
TABLES = ("table.csv", "table.md")
"""The tables in OUT: exact figures, and the same to read."""
SCENE = "{scene}"
"""Stands for a scene's name in the paths of options."""
_WHOLE_SCENES = (".sens", ".r3d")
"""Suffixes of files that hold all of a scene. Any other file has its pictures in its folder, or below."""
_NOTES_OF_SYSTEMS = ("thumbs.db", "desktop.ini")
"""Files that Windows hides and rewrites at will, in lower case."""
_LONGEST_NAME = 240
"""Bytes: the longest name of a scene, as files of its lift have this name and a few more letters."""


@dataclass(frozen=True)
class SceneJob:
    """A scene to lift into ``lift``. ``problem`` says why this is impossible; ``gigabytes`` is the memory that the lift
    is predicted to need; ``files`` is the `state_of_files` of the scene, "" if it is not mounted here."""

    name: str
    lift: Path
    request: LiftRequest
    gigabytes: float = 1.0
    problem: str = ""
    files: str = ""


@dataclass(frozen=True)
class BatchPlan:
    """The ``jobs`` of a batch, whose lifts are in the folder ``output``. ``chunk`` frames are baked in one piece; 0:
    only the lift bakes. ``exports`` are the formats to write."""

    output: Path
    jobs: tuple[SceneJob, ...]
    chunk: int = 0
    exports: tuple[str, ...] = ()

    def asked(self, job: SceneJob) -> str:
        """Return a digest of the request for a scene and of the scene's files."""
        about = {
            "request": job.request.to_json(job.lift), "bakes": bool(self.chunk), "exports": sorted(self.exports),
            "files": job.files,
        }  # fmt: skip
        return hashlib.sha256(json.dumps(about, sort_keys=True, default=str).encode()).hexdigest()


@dataclass(frozen=True)
class Row:
    """A scene's row in the table of results: how it ended (``state``), and why (``reason``, ``exit_code``). ``metrics``
    are the lift's own, in the mode ``strict``; ``code`` is the digest of the code that lifted it."""

    scene: str
    state: str
    seconds: float
    reason: str
    exit_code: int
    metrics: Mapping[str, Json]
    code: str = ""


def state_of_files(request: LiftRequest, output: Path) -> str:
    """Return a digest of the paths, sizes and times of all files that a lift may read, except those in the batch's
    ``output``. No file is opened: if the digest differs, the lift itself checks whether its scene has changed."""
    found, scene, masks, classes = hashlib.sha256(), request.scene, request.masks, request.classes or ""
    paths = [scene, masks, request.detections, request.depth, Path(classes) if classes.endswith(".toml") else None]
    if scene.is_file():
        paths.append(scene.with_suffix("") if scene.suffix.lower() in _WHOLE_SCENES else scene.parent)
    if masks is not None and masks.is_file():
        paths += [masks.with_suffix(""), masks.with_name("classes.toml")]
    for path in (path for top in paths if top is not None for path in _files_in(top, output)):
        with suppress(OSError):  # a link that leads nowhere, or a file that has gone since
            state = os.stat(path)
            found.update(os.fsencode(path) + f"\0{state.st_size} {state.st_mtime_ns}\0".encode())
    return found.hexdigest()


def _files_in(top: Path, output: Path) -> Iterator[Path]:
    """Yield ``top`` itself if it is a file, else all files in it, also behind links, but each folder only once. Hidden
    files, lifts and ``output`` are skipped."""
    seen = {os.path.realpath(output)} - {os.path.realpath(top)}  # a scene may itself be the output folder
    if top.is_file():
        yield top
    for folder, folders, names in os.walk(top, followlinks=True):
        there = os.path.realpath(folder)
        is_left_out = there in seen or ("request.json" in names and Path(folder) != top)
        folders[:] = [] if is_left_out else sorted(name for name in folders if name[0] != ".")  # in place, for os.walk
        shown = (name for name in sorted(names) if name[0] != "." and name.lower() not in _NOTES_OF_SYSTEMS)
        yield from () if is_left_out else (Path(folder, name) for name in shown)
        seen.add(there)


def of_scene(path: Path | None, name: str) -> Path | None:
    """Return a path with {scene} replaced by the scene's name; None for None."""
    return None if path is None else Path(str(path).replace(SCENE, name))


def refuse_shared(option: str, path: Path | str | None, scenes: int) -> None:
    """Raise PlgsError if several ``scenes`` would use the same ``path`` of an ``option`` for files of one scene."""
    if path is not None and SCENE not in str(path) and scenes > 1:
        fix = f"Write {SCENE} where the scene's name belongs, such as {option} 'predictions/{SCENE}'."
        raise PlgsError("shared-path", f"{option} names one path for {scenes} scenes", path, fix, option=option)


def names_of(scenes: Sequence[Path], given: Sequence[str] = ()) -> list[str]:
    """Return a name for each scene: the ``given`` one, or if that is "", that of its folder, its file, or the link to
    it. Raises PlgsError for a scene that is given twice, for two with the same name (even in different case, as some
    disks ignore it), and for a name that no folder can have ("...zip")."""
    names = [name or _name(scene) for name, scene in zip(given or [""] * len(scenes), scenes, strict=True)]
    folded = [name.casefold() for name in names]
    real = [os.path.realpath(scene) for scene in scenes]
    for name, scene, path in zip(names, scenes, real, strict=True):
        if real.count(path) > 1:
            raise PlgsError("scene-twice", "the scene is given twice", scene, "Name it once.")
        if not _is_folder_name(name):
            fix = "Rename the scene, or name it in a table of scenes (--scenes)."
            raise PlgsError("scene-unnamable", "this scene's name cannot be used for a result folder", scene, fix)
        if folded.count(name.casefold()) > 1 or name.casefold() in (RECORDS, *TABLES):
            fix = "Rename the scene, or name it in a table of scenes (--scenes)."
            raise PlgsError("names-clash", f"two scenes, or files of the batch, are named {name!r}", scene, fix)
    return names


def _name(scene: Path) -> str:
    if not os.path.isdir(scene):
        return scene.stem
    # abspath keeps the name of a link, but takes the ".." in "link/.." for the folder that holds the link.
    return Path(os.path.realpath(scene) if ".." in scene.parts else os.path.abspath(scene)).name


def _is_folder_name(name: str) -> bool:
    try:
        is_plain = inner_path(name).parts == (name,) and len(name.encode()) <= _LONGEST_NAME
    except ValueError:  # it leads out of the folder, or is not UTF-8
        return False
    return is_plain and name.isprintable() and name.strip(". ") != ""


def done_before(plan: BatchPlan, job: SceneJob) -> Row | None:
    """Return the row of an earlier batch with the same request, None unless its result and exports still exist."""
    found = _read(_record(plan.output, job.name))
    if found is None or found[1].state != "done":
        return None
    record, row = found
    try:
        check_sizes(job.lift / "result")
    except PlgsError:
        return None
    is_same = record.get("asked") == plan.asked(job) and record.get("result") == _result(job.lift)
    is_same = is_same and all(OwnFiles(job.lift / "exports" / form).is_complete for form in plan.exports)
    return row if is_same else None


def rows_kept(plan: BatchPlan) -> Iterator[Row]:
    """Yield other scenes' rows of earlier batches in the same folder, by name. Scenes whose result is gone are left
    out, as are failed scenes that no longer exist. A row whose result was changed since has the state "changed"."""
    names = {job.name for job in plan.jobs}
    found = [_read(path) for path in sorted((plan.output / RECORDS).glob("*.json"))]
    for record, row in sorted(filter(None, found), key=lambda each: each[1].scene):
        result = _result(plan.output / row.scene)
        if row.scene in names or not (result if row.state == "done" else os.path.exists(str(record.get("scene")))):
            continue
        if row.state == "done" and result != record.get("result"):
            row = replace(row, state="changed", reason="was corrected or lifted again: give it to the batch again")
        yield row


def remember(plan: BatchPlan, job: SceneJob, row: Row) -> None:
    """Save a row for the next batch. Raises OSError."""
    path = _record(plan.output, job.name)
    path.parent.mkdir(exist_ok=True)
    about = {"asked": plan.asked(job), "scene": str(job.request.scene), "result": _result(job.lift)}
    write_atomically(path, json.dumps({**about, "row": asdict(row)}, indent=1) + "\n")


def lifting_code(lift: Path) -> str:
    """Return the digest of the code that made a result; "" if its manifest lacks it."""
    try:
        return str(read_manifest(lift / "result").versions.get("code", ""))
    except PlgsError:
        return ""


def _record(output: Path, name: str) -> Path:
    return output / RECORDS / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.json"


def _read(path: Path) -> tuple[dict[str, Json], Row] | None:
    """Read what `remember` wrote; None if it is missing or damaged, as the pieces then find out what is done."""
    try:
        record = read_object(path, "Delete it.")
        row: Any = record["row"]
        return record, Row(**{**row, "scene": str(row["scene"]), "seconds": float(row["seconds"])})
    except (PlgsError, KeyError, TypeError, ValueError):
        return None


def _result(lift: Path) -> str:
    """Return a digest of the result on disk and its corrections; "" without a result."""
    files = [lift / "result" / "manifest.json", lift / "corrections.json"]
    there = [path.read_bytes() for path in files if path.is_file()]
    return hashlib.sha256(b"\n".join(there)).hexdigest() if files[0].is_file() else ""


COLUMNS = {
    "miou": "mIoU %", "miou_true": "true %", "pq": "PQ %", "sq": "SQ %", "rq": "RQ %",
    "psnr": "PSNR dB", "ssim": "SSIM", "depth_error_m": "depth cm",
}  # fmt: skip
_FACTORS = {"miou": 100.0, "miou_true": 100.0, "pq": 100.0, "sq": 100.0, "rq": 100.0, "depth_error_m": 100.0}


def write_tables(folder: Path, rows: Sequence[Row]) -> str:
    """Write table.csv, with the exact figures, and table.md, whose text is returned. Raises PlgsError for tables of
    other programs, OSError."""
    text = markdown(rows)
    with own_tables(folder) as own:
        write_atomically(folder / "table.csv", _csv(rows))
        write_atomically(folder / "table.md", text)
    own.complete()
    return text


def own_tables(folder: Path) -> OwnFiles:
    """Open the note of our files in a batch's folder. Raises PlgsError if tables are not ours or changed; OSError."""
    own = OwnFiles(folder).begin("tables", {}, among_others=True)
    for name in TABLES:
        own.refuse_foreign(folder / name)
    return own


def _csv(rows: Sequence[Row]) -> str:
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")  # the default is "\r\n"
    writer.writerow(["scene", "state", "seconds", *COLUMNS, "code", "reason"])
    for row in rows:
        figures = [_figure(row, key) for key in COLUMNS]
        cells = [row.scene, row.state, round(row.seconds, 1), *figures, row.code, row.reason]
        writer.writerow([table_cell(cell) for cell in cells])
    writer.writerow(["mean", "", *_means(rows), "", ""])
    return file.getvalue()


def markdown(rows: Sequence[Row]) -> str:
    """Return the table in Markdown: shares in per cent, lengths in cm, and a dash if a scene has no ground truth."""
    lines = [["scene", "state", "minutes", *COLUMNS.values(), "reason"]]
    for row in rows:
        figures = [_shown(key, _figure(row, key)) for key in COLUMNS]
        lines.append([row.scene, row.state, f"{row.seconds / 60:.1f}", *figures, row.reason])
    seconds, *means = _means(rows)
    shown = [_shown(key, mean) for key, mean in zip(COLUMNS, means, strict=True)]
    lines.append(["**mean**", "", "-" if seconds is None else f"{seconds / 60:.1f}", *shown, ""])
    cells = [[markdown_cell(cell) for cell in line] for line in lines]
    body = ["| " + " | ".join(line) + " |" for line in cells]
    codes = Counter(row.code or "unknown" for row in rows if row.state == "done")
    counted = ", ".join(f"{code} ({count})" for code, count in codes.most_common())
    differ = ["", f"Lifted by different versions of the code: {counted}."] if len(codes) > 1 else []
    return "\n".join([body[0], "|" + "---|" * len(lines[0]), *body[1:], *differ, ""])


def _figure(row: Row, key: str) -> float | None:
    value = row.metrics.get(key)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _means(rows: Sequence[Row]) -> list[float | None]:
    """Return the mean of each figure over the scenes that are done and have it; None where no scene has it."""
    done = [row for row in rows if row.state == "done"]
    seconds: list[float | None] = [row.seconds for row in done]
    columns = [seconds, *([_figure(row, key) for row in done] for key in COLUMNS)]
    known = [[value for value in column if value is not None] for column in columns]
    return [sum(column) / len(column) if column else None for column in known]


def _shown(key: str, value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value * _FACTORS.get(key, 1.0):.{3 if key == 'ssim' else 1}f}"
