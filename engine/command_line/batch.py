"""The commands `python -m engine batch` and `python -m engine worker`."""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ..errors import ExitCode, PlgsError, reading
from ..gates import read_plain
from ..job.request import add_lift_options, add_progress_option, readable, request_from
from ..job.studio import filled_in

if TYPE_CHECKING:
    from ..batch import SceneJob
    from ..batch.cluster import FarmOptions, Tls

SLURM = {"queue": "--queue", "account": "--account", "walltime": "--walltime"}


def add_batch(parser: argparse.ArgumentParser, exports: Sequence[str]) -> None:
    parser.description = (
        "Lift, bake, export and score many scenes, on workers of this machine, of a Dask scheduler, or of Slurm. "
        "Results go to OUT/NAME, where NAME is that of the scene's folder or file, and to OUT/table.csv and table.md. "
        "The same command continues with what is missing; one for other scenes adds to the table. {scene} in --masks, "
        "--detections, --depth and --names-from stands for a scene's name. Docs: docs/farms.md."
    )
    parser.add_argument("scenes", type=Path, nargs="*", metavar="SCENE", help="scenes, as for lift")
    parser.add_argument(
        "--scenes", type=Path, dest="table", metavar="FILE.csv|FILE.toml",
        help="a table of scenes: a column scene, and name, up, masks or other options of lift for each (docs/farms.md)",
    )  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="the folder for all results")
    add_lift_options(parser)
    parser.add_argument("--chunk", type=positive, default=50, metavar="N", help="frames per piece of --bake all (50)")
    forms = f"forms to export: {', '.join(exports)}"
    parser.add_argument("--export", nargs="+", choices=exports, default=(), metavar="FORM", help=forms)
    add_progress_option(parser)
    where = parser.add_argument_group("where", "Without any of these, workers run on this machine within its memory.")
    where.add_argument("--workers", type=positive, metavar="N", help="workers on this machine, or Slurm jobs")
    where.add_argument(
        "--scheduler", default="", metavar="ADDRESS", help="a Dask scheduler, such as tcp://machine:8786"
    )
    where.add_argument("--slurm", action="store_true", help="let Slurm start the workers, with dask-jobqueue")
    where.add_argument("--memory", type=float, default=0.0, metavar="GB", help="memory of one worker")
    where.add_argument("--threads", type=positive, metavar="N", help="compute threads of one worker")
    for name, option in SLURM.items():
        where.add_argument(option, default="", metavar=name.upper(), help=f"with --slurm: sbatch's {name}")
    _add_tls(where)
    parser.set_defaults(run=batch)


def add_worker(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Work for the scheduler of batches, one piece at a time. Ends when the scheduler has been gone for a minute. "
        "The scenes and the folder of the batch must be mounted here under the same paths."
    )
    parser.add_argument("address", metavar="ADDRESS", help="the scheduler's address, such as tcp://machine:8786")
    parser.add_argument("--memory", type=float, default=0.0, metavar="GB", help="memory to use (default: all)")
    parser.add_argument("--threads", type=positive, metavar="N", help="compute threads to use (default: all)")
    _add_tls(parser)
    parser.add_argument(
        "--stay-with-parent", action="store_true", help="end when standard input ends (a parent holds it open)"
    )
    parser.set_defaults(run=worker)


def _add_tls(parser: argparse._ActionsContainer) -> None:
    about = "certificate of the authority that signed those of scheduler, workers and batch: Dask's connections use TLS"
    parser.add_argument("--tls-ca", type=Path, metavar="FILE.pem", help=about)
    parser.add_argument(
        "--tls-certificate", type=Path, metavar="FILE.pem", help="with --tls-ca: this machine's certificate and its key"
    )


def _tls(options: argparse.Namespace) -> Tls | None:
    """Return the TLS files that the options name, or None. Raises PlgsError if only one of the two is given."""
    from ..batch.cluster import Tls

    ca, own = options.tls_ca, options.tls_certificate
    if (ca is None) != (own is None):
        raise PlgsError("tls-files", "TLS needs two files", ca or own, "Give --tls-ca and --tls-certificate.")
    return None if ca is None else Tls(ca.absolute(), own.absolute())


def positive(text: str) -> int:
    """Parse a positive whole number, for argparse. Raises ArgumentTypeError."""
    if not text.isdecimal() or not 0 < int(text) < 10**6:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 1")
    return int(text)


def worker(options: argparse.Namespace) -> ExitCode:
    from ..batch import run_worker

    pipe = sys.stdin.fileno() if options.stay_with_parent else None
    return run_worker(
        options.address, gigabytes=options.memory, threads=options.threads or 0, parent_pipe=pipe, tls=_tls(options)
    )


def batch(options: argparse.Namespace) -> int:
    from ..batch import BatchPlan, run_batch
    from ..batch.plan import RECORDS, names_of
    from ..job import EventWriter
    from ..job.task import TaskFiles
    from ..job.terminal import Interrupted, Interrupts

    options = filled_in(options)
    scenes = _asked_scenes(options)
    names = names_of([each.scene for each in scenes], [each.scene_name for each in scenes])
    if ".." in options.output.parts:
        options.output = options.output.resolve()
    bakes_all = options.bake == "all"
    _refuse_conflicts(options)
    jobs = tuple(_job(own, options.output.absolute(), name, bakes_all) for own, name in zip(scenes, names, strict=True))
    plan = BatchPlan(options.output.absolute(), jobs, options.chunk if bakes_all else 0, tuple(options.export))
    farm_options = _farm_options(options, [job.gigabytes for job in jobs], plan.output / RECORDS / "jobs")
    own = TaskFiles.temporary() if options.echo is not None else None
    events = EventWriter(own.events, options.echo) if own is not None else None
    state = ""
    try:
        with Interrupts() as interrupts, interrupts.deferred():
            ended = run_batch(plan, farm_options, interrupts, events)
        state = "finished"
        return ended
    except PlgsError as error:
        if events is not None:
            events.error(error)
        raise
    except Interrupted as error:
        state = "cancelled"
        print(f"Stopped. Give the same command again to continue: {options.output}", file=sys.stderr)
        return error.exit_code
    finally:
        if events is not None and own is not None:
            if state:
                events.done(state)
            events.close()
            own.discard()


def _asked_scenes(options: argparse.Namespace) -> list[argparse.Namespace]:
    """Return each scene's options, with ``scene`` and ``scene_name`` ("" if not given). Raises PlgsError without a
    scene, or if several would share a path."""
    from ..batch.plan import refuse_shared

    if options.poses is not None:
        what = "finds the poses of one scene only"
        raise PlgsError("one-scene-only", what, "--poses", "Find them first: python -m engine poses.")
    asked = [argparse.Namespace(**{**vars(options), "scene": scene, "scene_name": ""}) for scene in options.scenes]
    if options.table is not None:
        asked += read_scene_table(options.table, options)
    if not asked:
        raise PlgsError("no-scene", "no scene is named", "batch", "Name scenes, or a table of them with --scenes.")
    for option in _PATHS[1:]:
        refuse_shared(f"--{option}", getattr(options, option.replace("-", "_")), len(asked))
    return asked


def _refuse_conflicts(options: argparse.Namespace) -> None:
    if options.slurm and options.scheduler:
        raise PlgsError("scheduler-and-slurm", "cannot be used with --scheduler", "--slurm", "Give only one of them.")
    if options.workers and options.scheduler:
        what = "a scheduler has its own workers"
        raise PlgsError("scheduler-workers", what, "--workers", "Leave out this option, or --scheduler.")
    for name, option in SLURM.items():
        if getattr(options, name) and not options.slurm:
            raise PlgsError("slurm-only", "needs Slurm", option, "Add --slurm, or leave it out.", option=option)
    if options.tls_ca and not (options.slurm or options.scheduler):
        fix = "Leave it out: without --slurm and --scheduler nothing listens beyond this machine."
        raise PlgsError("farm-only", "applies only to other machines", "--tls-ca", fix, option="--tls-ca")


def _job(own: argparse.Namespace, output: Path, name: str, bakes_all: bool) -> SceneJob:
    from ..batch import SceneJob
    from ..batch.plan import of_scene, state_of_files
    from ..job import StopSignal
    from ..job.prediction import USUAL_MASKS
    from ..job.progress import StageProgress
    from ..lift.frame_sets import predicted_lift
    from ..scene import open_scene_to_lift
    from .runner import ShownEvents

    scene, lift = own.scene, output / name
    for option in (each.replace("-", "_") for each in _PATHS[1:]):
        setattr(own, option, of_scene(getattr(own, option), name))
    request = request_from(own)
    if bakes_all:
        request = replace(request, bake="none")  # passes are baked in pieces after the lift
    if not scene.exists() and (own.scheduler or own.slurm):
        return SceneJob(name, lift, request)  # a worker may have the scene
    shown = ShownEvents(sys.stderr, as_json=False)
    shown.stage("open", 1, 1, f"Opening {name}")
    try:
        opened = open_scene_to_lift(request, StageProgress("open", shown, StopSignal()))
        files = state_of_files(request, output)  # walked only if readable
    except PlgsError as error:
        return SceneJob(name, lift, request, problem=str(error))
    finally:
        shown.close()
    peak = predicted_lift(opened, request.chosen_preset, USUAL_MASKS).peak_bytes
    return SceneJob(name, lift, request, round(peak / 1e9, 2), files=files)


def _farm_options(options: argparse.Namespace, gigabytes: Sequence[float], logs: Path) -> FarmOptions:
    """Return the farm that the options ask for; by default as many workers here as processors allow, and memory for
    lifts of this many ``gigabytes``. ``logs`` is for Slurm's jobs."""
    from ..batch.cluster import FarmOptions
    from ..job.system import main_memory, usable_cpus

    slurm = {name: getattr(options, name) for name in SLURM} if options.slurm else None
    memory = main_memory()
    total, cpus = (memory.total / 1e9 if memory is not None else 4.0), usable_cpus()
    fits = math.floor(total / max(max(gigabytes), 1.0))
    workers = options.workers or max(1, min(fits, cpus // 2, len(gigabytes)))  # at least two threads each
    is_here = slurm is None and not options.scheduler
    share = total / workers if is_here else max([*gigabytes, 4.0])
    threads = options.threads or (max(1, cpus // workers) if is_here else 4)
    share = round(options.memory or share, 2)
    return FarmOptions(workers, options.scheduler, slurm, share, threads, _tls(options), logs)


_MOST_BYTES = 1 << 26
_PATHS = ("scene", "masks", "detections", "depth", "names-from")
_OF_ALL = ("bake", "poses")
_SWITCHES = ("fit", "anyway")
_FIX = "Write a column (CSV) or a key of a [[scene]] (TOML) 'scene', and others named as options of lift."


def read_scene_table(path: Path, options: argparse.Namespace) -> list[argparse.Namespace]:
    """Return a copy of the command line's ``options`` for each scene of a table, changed as its row says, with
    ``scene`` and ``scene_name`` ("" if not given). Paths are relative to the table. Raises PlgsError for a bad one."""
    found = []
    for number, row in enumerate(_rows(path), start=1):
        where = f"{path}, scene {number}"
        if not row.get("scene"):
            raise PlgsError("row-without-scene", "a scene has no 'scene'", where, _FIX)
        if of_all := [name for name in _OF_ALL if row.get(name)]:
            what = f"{of_all[0]} cannot differ between scenes"
            raise PlgsError("option-of-all", what, where, "Give it on the command line.")
        parser = _RowParser(where)
        parser.add_argument("--scene", type=Path)
        parser.add_argument("--name", dest="scene_name")
        add_lift_options(parser)
        arguments = [each for name, value in row.items() for each in _arguments(name, value, path.parent, where)]
        given = argparse.Namespace(**{**vars(options), "scene": None, "scene_name": ""})
        found.append(parser.parse_args(readable(arguments), given))
    return found


class _RowParser(argparse.ArgumentParser):
    """A parser for the options in a row of a table, whose errors are PlgsError."""

    def __init__(self, where: str) -> None:
        super().__init__(add_help=False, allow_abbrev=False)  # a column "help" must not print help and exit
        self._where = where

    def error(self, message: str) -> NoReturn:
        raise PlgsError("row-option", message, self._where, _FIX)


def _arguments(name: str, value: Any, folder: Path, where: str) -> Iterator[str]:
    """Yield the option ``name`` with a cell's ``value`` as command-line arguments; paths are relative to ``folder``.
    Raises PlgsError, which names the place ``where``, for a value that is no text, number, list or true."""
    if isinstance(value, list):
        for each in value:
            yield from _arguments(name, each, folder, where)
    elif value is True or (name in _SWITCHES and str(value).lower() in ("true", "yes", "1")):
        yield f"--{name}"
    elif name in _SWITCHES and str(value).lower() in ("false", "no", "0"):
        return
    elif isinstance(value, str | int | float) and value is not False:
        is_path = name in _PATHS or str(value).endswith(".toml")
        yield f"--{name}={folder / str(value) if is_path else value}"  # "=", as a value may begin with a dash
    elif value is not False:
        raise PlgsError("row-value", f"{name} cannot be {value!r}", where, _FIX)


def _rows(path: Path) -> list[Mapping[str, Any]]:
    """Read a table's rows, one per scene, as options by name, without empty cells. Raises PlgsError for a bad table."""
    try:
        with reading(path, "Name a CSV or TOML file of scenes."):
            text = read_plain(path, _MOST_BYTES).decode("utf-8-sig")  # Excel writes a byte order mark
        if path.suffix.lower() == ".toml":
            rows: Any = tomllib.loads(text).get("scene")
        else:
            rows = [*csv.DictReader(io.StringIO(text), restkey="", strict=True)]  # cells beyond the header: option ""
        found: list[Mapping[str, Any]] = [
            {str(name).strip().replace("_", "-"): value for name, value in row.items() if value not in (None, "")}
            for row in rows
        ]
    except (ValueError, TypeError, AttributeError, csv.Error) as error:
        raise PlgsError("not-scene-table", f"is not a table of scenes ({error})", path, _FIX) from error
    if not found:
        raise PlgsError("empty-scene-table", "names no scene", path, _FIX)
    return found
