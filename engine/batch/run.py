"""Run a batch, from its plan to its table."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from uuid import uuid4

from ..errors import ErrorCode, ExitCode, PlgsError
from ..job import EventWriter, LiftFolder
from ..job.folder import refuse_foreign_below
from ..job.lock import FileLock
from ..job.report import wrong_with_scene
from ..job.task import TaskProgress
from ..job.terminal import Interrupts, LiveLine
from ..json_file import Json
from .cluster import RETURN_S, Farm, FarmOptions, opened, reconnected
from .piece import GIGABYTES, TOPIC, Ended, Kind, Outcome, Piece, do_on_dask, engine_tag
from .plan import (
    RECORDS,
    TABLES,
    BatchPlan,
    Row,
    SceneJob,
    done_before,
    lifting_code,
    own_tables,
    remember,
    rows_kept,
    write_tables,
)  # fmt: skip

_POLL_S = 0.2
_LOOK_S = 1.0  # seconds between two checks of the workers
_JOBS_S = 10.0  # seconds between two queries to Slurm about whether jobs without a worker still wait or run
_TABLE_S = 60.0  # seconds for which a batch waits while another writes the table
_ENDING_S = 10.0  # seconds that engines may take to stop on Ctrl-C
_PRIORITY = {Kind.LIFT: 0, Kind.BAKE: 1, Kind.EXPORT: 2, Kind.SCORE: 3}
"""Scenes that were begun are finished first, and earlier scenes before later ones."""
LIFTED, STRICT = "lifted", "strict"
STOPPED = "stopped"
"""The state of a scene that Ctrl-C left unfinished."""


@dataclass
class _Scene:
    """A scene in a batch: its ``stages`` of pieces to do, how many pieces are ``out`` on workers, and what is ``wrong``
    with it ("": nothing). ``unfit`` gives, by a worker's address, why the worker cannot do the scene."""

    job: SceneJob
    index: int
    stages: Iterator[list[Piece]]
    out: int = 0
    seconds: float = 0.0
    unfit: dict[str, str] = field(default_factory=dict)
    metrics: Mapping[str, Json] = field(default_factory=dict)
    wrong: str = ""
    frames: Sequence[str] = ()


def run_batch(
    plan: BatchPlan, farm_options: FarmOptions, interrupts: Interrupts, events: EventWriter | None = None
) -> ExitCode:
    """Do what a batch still needs, show it on standard error and in ``events``, write the table and print it, with the
    rows of earlier batches in the same folder. Failed scenes are rows with their reason; the exit code is that of the
    first of them. Call it inside `interrupts.deferred()`. Raises PlgsError if nothing can begin, and OSError."""
    refuse_foreign_below(plan.output, (RECORDS,))
    own_tables(plan.output)
    (plan.output / RECORDS).mkdir(parents=True, exist_ok=True)
    report = BatchReport(events, farm_options.threads)
    rows = {job.name: row for job in plan.jobs if (row := done_before(plan, job)) is not None}
    for job in plan.jobs:
        if job.problem:
            rows[job.name] = row = Row(job.name, Ended.FAILED, 0.0, job.problem, ExitCode.BAD_INPUT, {})
            report.ended(row)
    missing = [job for job in plan.jobs if job.name not in rows]
    if missing:
        with opened(farm_options) as farm:
            dashboard = "" if find_spec("bokeh") else " (its pages need the package bokeh)"
            report.say(f"Scheduler: {farm.address}. Dashboard: {farm.client.dashboard_link}{dashboard}")
            batch = _Batch(plan, farm, report, rows)
            batch.run(missing, interrupts)
    report.end()
    ordered = [rows[job.name] for job in plan.jobs]
    files = [plan.output / name for name in TABLES]
    with _turn(plan):
        for job in plan.jobs:
            if rows[job.name].state != Ended.DONE:  # the others were recorded as they ended
                remember(plan, job, rows[job.name])
        text = write_tables(plan.output, [*ordered, *rows_kept(plan)])
    print(text, *reversed(files), sep="\n", flush=True)
    if events is not None:
        events.answer({"rows": [asdict(row) for row in ordered], "table": str(files[0])})
    return ExitCode(next((row.exit_code for row in ordered if row.exit_code), 0))


def _turn(plan: BatchPlan) -> FileLock:
    """The lock that a batch holds while it writes rows and tables, as another batch may write, too; for ``with``."""
    return FileLock(plan.output / RECORDS / "table.lock", _TABLE_S)


class _Batch:
    """The state of a running batch: the submitted pieces, and what came of them."""

    def __init__(self, plan: BatchPlan, farm: Farm, report: BatchReport, rows: dict[str, Row]) -> None:
        self._plan, self._farm, self._report, self._rows = plan, farm, report, rows
        self._scenes: dict[str, _Scene] = {}
        self._out: dict[Any, Piece] = {}
        self._pins: dict[Any, tuple[Sequence[str], float]] = {}
        """The addresses of the only workers that can do a piece, and when one of them was last there."""
        self._progress_texts: dict[str, str] = {}
        self._looked = self._staffed = self._asked = time.monotonic()
        self._is_missed = False

    def run(self, jobs: Sequence[SceneJob], interrupts: Interrupts) -> None:
        self._listen()
        for index, job in enumerate(jobs):
            cancel: Path = job.lift / "cancel"  # of an earlier batch: it would stop a bake
            if cancel.exists() and not LiftFolder.open(job.lift).is_running:
                cancel.unlink(missing_ok=True)  # another batch may do so in this moment
            self._scenes[job.name] = _Scene(job, index, iter(()))
        for scene in self._scenes.values():
            scene.stages = self._stages(scene)
            self._next_stage(scene)
        while self._out:
            if interrupts.pending is not None:
                self._stop()
                return
            self._farm.tend()
            self._take_in()
            self._look_at_workers()
            left = [scene for name, scene in self._scenes.items() if name not in self._rows]
            running = "; ".join(self._progress_texts.values())
            self._report.show(len(self._scenes) - len(left), len(self._scenes), running)
            time.sleep(_POLL_S)

    def _stages(self, scene: _Scene) -> Iterator[list[Piece]]:
        job, plan = scene.job, self._plan

        def piece(kind: Kind, *names: str) -> Piece:
            return Piece(kind, job.name, job.lift, job.request, engine_tag(), names)

        yield [replace(piece(Kind.LIFT), tells_frames=bool(plan.chunk))]
        if plan.chunk:
            starts = range(0, len(scene.frames), plan.chunk)
            yield [piece(Kind.BAKE, *scene.frames[start : start + plan.chunk]) for start in starts]
        if plan.exports:
            yield [piece(Kind.EXPORT, form) for form in plan.exports]
        yield [piece(Kind.SCORE)]

    def _next_stage(self, scene: _Scene) -> None:
        for stage in scene.stages:
            if stage:
                scene.out = len(stage)
                for piece in stage:
                    if scene.job.name not in self._rows:  # the piece before it may have failed
                        self._submit(piece)
                return
        code = lifting_code(scene.job.lift)
        self._end(scene, Row(scene.job.name, Ended.DONE, scene.seconds, scene.wrong, 0, scene.metrics, code))

    def _submit(self, piece: Piece) -> None:
        scene = self._scenes[piece.scene]
        wanted = {engine_tag(): 1.0}
        if piece.kind is Kind.LIFT:
            largest = self._farm.largest()
            if largest and scene.job.gigabytes > largest:
                what = f"the lift needs about {scene.job.gigabytes:.1f} GB, but the largest worker has {largest:.1f} GB"
                self._fail(scene, PlgsError("too-big", what, scene.job.request.scene, "Add --fit, or a larger worker."))
                return
            wanted[GIGABYTES] = scene.job.gigabytes
        fit = [address for address in self._farm.workers() if address not in scene.unfit] if scene.unfit else None
        if fit == []:
            why = "; ".join(sorted({reason.rstrip(".") for reason in scene.unfit.values()}))
            fix = "Fix this, then start the batch again."
            self._fail(scene, PlgsError("no-fit-worker", f"no worker can take this scene: {why}", "", fix))
            return
        future = self._farm.client.submit(  # with a new key, as Dask would answer a known one with its old result
            do_on_dask, piece, key=f"{piece.kind}-{piece.scene}-{uuid4().hex}", pure=False, resources=wanted,
            priority=_PRIORITY[piece.kind] * len(self._scenes) - scene.index, workers=fit,
        )  # fmt: skip
        self._out[future] = piece
        if fit is not None:
            self._pins[future] = fit, time.monotonic()

    def _look_at_workers(self) -> None:
        """Report if there has been no worker for long. If all workers that a piece was assigned to have left, submit it
        again once other workers are there; if none has come for long, `_submit` reports that."""
        now = time.monotonic()
        if now < self._looked + _LOOK_S or self._farm.client.status != "running":
            return
        self._looked = now
        try:
            there = self._farm.workers()
        except (OSError, KeyError):  # the scheduler is gone: `_take_in` waits for its return
            return
        if there:
            self._staffed, self._asked, self._is_missed = now, now, False
        elif now > self._asked + _JOBS_S:
            self._asked = now
            try:
                self._farm.refuse_dead_jobs()
            except PlgsError as error:
                for scene in [each for name, each in self._scenes.items() if name not in self._rows]:
                    self._fail(scene, error)
                return
        if not there and not self._is_missed and now > self._staffed + RETURN_S:
            self._is_missed = True
            start = f"Start one: python -m engine worker {self._farm.address}"
            self._report.say(f"Waiting for a worker. {start if self._farm.slurm is None else 'squeue shows its job.'}")
        for future, (workers, seen) in [*self._pins.items()]:
            if future not in self._out:
                continue  # another piece of the scene could not be placed
            piece = self._out[future]
            if not there or there.keys() & set(workers):
                self._pins[future] = workers, now
            elif there.keys() - self._scenes[piece.scene].unfit or now > seen + RETURN_S:
                self._withdraw(future)
                self._submit(piece)

    def _withdraw(self, future: Any) -> None:
        """Cancel a submitted piece. A worker that has begun it stops."""
        del self._out[future]
        self._pins.pop(future, None)
        future.cancel()

    def _take_in(self) -> None:
        """Handle the pieces that ended. If the scheduler was lost, wait for it and submit all pieces again."""
        if self._farm.client.status != "running" or any(future.cancelled() for future in self._out):
            self._report.say("The scheduler does not answer any more. Waiting for it.")
            reconnected(self._farm)
            self._listen()
            pieces, self._out, self._pins = [*self._out.values()], {}, {}
            for piece in pieces:
                if piece.scene not in self._rows:
                    self._submit(piece)
            return
        for future in [future for future in self._out if future.done()]:
            if future not in self._out:
                continue  # another piece of the scene has failed
            piece = self._out.pop(future)
            self._pins.pop(future, None)
            scene = self._scenes[piece.scene]
            if future.status == "error":
                what = f"its lift crashed the workers ({type(future.exception()).__name__}: {future.exception()})"
                error = PlgsError("crashed", what, scene.job.lift, "Their logs may say more.", code=ErrorCode.INTERNAL)
                self._fail(scene, error)
            else:
                self._take(scene, future.result())

    def _take(self, scene: _Scene, outcome: Outcome) -> None:
        piece = outcome.piece
        scene.seconds += outcome.seconds
        self._progress_texts.pop(piece.scene, None)
        if outcome.ended is Ended.ELSEWHERE:
            self._report.say(f"{piece.scene}: not possible on {outcome.worker}: {outcome.reason}")
            workers = self._farm.workers()
            # An outcome names its worker as machine and name.
            unfit = [each for each, worker in workers.items() if str(worker["name"]) == outcome.worker.split()[-1]]
            scene.unfit |= {each: f"{outcome.worker}: {outcome.reason}" for each in unfit}
            self._submit(piece)
            return
        if outcome.ended is Ended.KILLED and not piece.is_resumed:
            fewer = outcome.lacked_memory and self._farm.use_fewer(outcome.worker)
            about = ", with a worker less, as memory was short" if fewer else ""
            self._report.say(f"{piece.scene}: {outcome.reason} It will be resumed once{about}.")
            self._submit(replace(piece, is_resumed=True))
            return
        if outcome.ended is not Ended.DONE:
            state = Ended.CANCELLED if outcome.ended is Ended.CANCELLED else Ended.FAILED
            self._end(scene, _row(scene, state, outcome.reason, outcome.exit_code))
            return
        if piece.tells_frames:
            frames = outcome.answer.get("frames")
            scene.frames = [str(name) for name in frames] if isinstance(frames, list) else []
        if piece.kind is Kind.SCORE:
            scene.metrics = lifted_metrics(outcome.answer)
            scene.wrong = "; ".join(wrong_with_scene(outcome.answer))
        scene.out -= 1
        if not scene.out:
            self._next_stage(scene)

    def _fail(self, scene: _Scene, error: PlgsError) -> None:
        self._end(scene, _row(scene, Ended.FAILED, str(error), error.exit_code))

    def _end(self, scene: _Scene, row: Row) -> None:
        name = scene.job.name
        self._rows[name] = row
        self._progress_texts.pop(name, None)
        for future in [future for future, piece in self._out.items() if piece.scene == name]:
            self._withdraw(future)
        if row.state == Ended.DONE:
            with suppress(PlgsError), _turn(self._plan):  # without its row, the next batch looks at the lift itself
                remember(self._plan, scene.job, row)
        self._report.ended(row)

    def _listen(self) -> None:
        def hear(event: tuple[float, Mapping[str, str]]) -> None:
            self._progress_texts[event[1]["scene"]] = f"{event[1]['scene']}: {event[1]['text']}"

        self._farm.client.subscribe_topic(TOPIC, hear)

    def _stop(self) -> None:
        self._report.say("Stopping ...")
        lifts = {self._scenes[piece.scene].job.lift for piece in self._out.values()}
        with suppress(Exception):  # the scheduler may be gone
            self._farm.client.cancel([*self._out], asynchronous=False)
        folders = [LiftFolder.open(lift) for lift in lifts if (lift / "request.json").exists()]
        for folder in folders:
            folder.task_files.ask_to_cancel()
        give_up = time.monotonic() + _ENDING_S
        while any(folder.is_running for folder in folders) and time.monotonic() < give_up:
            time.sleep(_POLL_S)
        for name, scene in self._scenes.items():
            if name not in self._rows:
                self._rows[name] = _row(scene, STOPPED, "give the same command again", ExitCode.CANCELLED)


def _row(scene: _Scene, state: str, reason: str, code: int) -> Row:
    return Row(scene.job.name, state, scene.seconds, reason, code or ExitCode.INTERNAL_ERROR, {})  # never 0


def lifted_metrics(metrics: Mapping[str, Json]) -> dict[str, Json]:
    """Return the entry of a metrics.json that scores the lift itself, without its classes; {} if there is none."""
    tables = metrics.get("tables")
    for table in tables if isinstance(tables, list) else []:
        if isinstance(table, dict) and table.get("name") == LIFTED and table.get("mode") in (STRICT, None):
            return {key: value for key, value in table.items() if key != "per_class"}
    return {}


BATCH = "batch"


class BatchReport:
    """Reports a batch's progress in a line of the terminal and in ``events``. ``threads`` are those of a worker."""

    def __init__(self, events: EventWriter | None, threads: int) -> None:
        self._line, self._events = LiveLine(sys.stderr), events
        self._shown = (-1, -1)
        if events is not None:
            events.hello(threads=threads, resumed=False, task=BATCH)
            events.stage(BATCH, 1, 1, "Batch")

    def say(self, text: str) -> None:
        """Print a line of text that is not overwritten."""
        self._line.say(" ".join(text.splitlines()))
        if self._events is not None:
            self._events.warning(text)

    def show(self, done: int, scenes: int, running: str) -> None:
        """Show how many scenes are done, and what is running."""
        label = f"Batch ({running})" if running else "Batch"
        self._line.show(TaskProgress(label=label, step=done, steps=scenes))
        if self._events is not None and (done, scenes) != self._shown:
            self._events.progress(BATCH, done, scenes)
        self._shown = done, scenes

    def ended(self, row: Row) -> None:
        """Report a scene's row as the event "metric" with the name "scene"."""
        about = f" in {row.seconds / 60:.1f} min" if row.state == Ended.DONE else ""
        about += f": {row.reason}" if row.reason else ""
        self._line.say(" ".join(f"{row.scene}: {row.state}{about}".splitlines()))
        if self._events is not None:
            figures = {name: value for name, value in row.metrics.items() if isinstance(value, int | float | str)}
            own = {name: value for name, value in asdict(row).items() if name != "metrics"}
            self._events.metric("scene", figures | own)

    def end(self) -> None:
        """End the live line, so that further output begins on a new line."""
        self._line.end()
