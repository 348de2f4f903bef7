"""What the processes of a farm do. Lifts are pretended: the real `run_engine` and checkpoints around some counting. Run
as a script, it is such a lift:

farm_worker.py lift LIFT [--resume] [--stay-with-parent]
"""

import os
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
# ruff: noqa: E402 - what follows is found only now

from engine.batch import BatchPlan, SceneJob, cluster, piece, run_batch
from engine.batch.cluster import FarmOptions
from engine.command_line.run_engine import run_engine
from engine.errors import ErrorCode, PlgsError
from engine.job import EventWriter, LiftFolder, LiftRequest, StopSignal
from engine.job.terminal import Interrupts
from tests.job.following import tiny_lift
from tests.waiting import PATIENCE_S

STEPS, STEP_S, PAUSE_AFTER = 30, 0.03, 10


def lift(folder: LiftFolder, events: EventWriter, stop: StopSignal, *, resume: bool) -> None:
    if (folder.request.scene / "dark").exists():
        raise PlgsError("made-up", "is too dark", folder.request.scene, "Switch the light on.")
    events.stage("train", 1, 2, "Training")
    checkpoint = folder.checkpoints.latest() if resume else None
    step = 0 if checkpoint is None else int(str(checkpoint.state["step"]))
    pause, done = folder.request.scene / "pause", 0
    while step < STEPS:
        step, done = step + 1, done + 1
        events.progress("train", step, STEPS, loss=1.0 / step, eta_s=STEP_S * (STEPS - step))
        folder.checkpoints.save({"step": step}, lambda path: (path / "model").write_bytes(b"model"))
        stop.check()
        end = time.monotonic() + PATIENCE_S
        while not resume and done > PAUSE_AFTER and pause.exists() and time.monotonic() < end:
            stop.check()
            time.sleep(STEP_S)
        time.sleep(STEP_S)
    tiny_lift(folder, events, stop, resume=resume)


def pretend(kind: str) -> None:
    """In place of what lifts, and of what looks at the machine."""

    def command(python: Path, lift: Path, *, resume: bool, program: str = "engine") -> list[str | Path]:
        return [sys.executable, Path(__file__), "lift", lift, *(["--resume"] if resume else [])]

    def full(*_: object) -> object:
        raise PlgsError("made-up", "the disk is full", "/scratch", "Make room there.", code=ErrorCode.DISK_FULL)

    started = piece._started
    piece._started = lambda each, variables: started(each, variables) if each.kind is piece.Kind.LIFT else None
    piece.engine_command = command
    if kind == "impatient":
        piece.STALL_S = 2.0
    if kind == "another-engine":
        cluster.engine_tag = lambda: "plgs-0.0.0-00000000"
    if kind == "full":
        piece._followed = full
    if kind == "unmounted":
        is_there = Path.exists
        Path.exists = lambda path, **more: "scenes" not in path.parts and is_there(path, **more)


def schedule(port: int, ttl_s: float, options: tuple[str, ...]) -> None:
    """A scheduler, which gives a worker up that it has not heard of for ``ttl_s``."""
    import dask
    from distributed.cli.dask_scheduler import main

    _be_quiet()
    dask.config.set({"distributed.scheduler.worker-ttl": f"{ttl_s}s"})
    main(["--host", "127.0.0.1", "--no-dashboard", "--port", str(port), *options])


def work(kind: str, address: str, *files: Path) -> None:
    """A worker of one of the kinds of `pretend`. ``files``: the authority's certificate, and its own."""
    _be_quiet()
    pretend(kind)
    cluster.run_worker(address, threads=1, patience_s=PATIENCE_S, tls=cluster.Tls(*files) if files else None)


def batch(address: str, output: Path, *scenes: Path) -> None:
    _be_quiet()
    jobs = tuple(SceneJob(scene.name, output / scene.name, LiftRequest(scene=scene)) for scene in scenes)
    with Interrupts() as interrupts, interrupts.deferred():
        sys.exit(run_batch(BatchPlan(output, jobs), FarmOptions(scheduler=address), interrupts))


def _be_quiet() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


if __name__ == "__main__":
    pipe = 0 if "--stay-with-parent" in sys.argv else None
    try:
        folder = LiftFolder.open(Path(sys.argv[2]))
        sys.exit(run_engine(folder, resume="--resume" in sys.argv, parent_pipe=pipe, lift=lift))
    except PlgsError as error:  # as the real command does: another engine may be at work
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)
