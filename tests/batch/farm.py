"""A farm on this machine: schedulers, workers and batches as forks of one process that has imported Dask and the
engine."""

import csv
import json
import multiprocessing
import random
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from engine.batch import BatchPlan, SceneJob, run_batch
from engine.batch.cluster import FarmOptions
from engine.errors import ExitCode
from engine.job import LiftRequest
from engine.job.terminal import Interrupts
from tests.batch import farm_worker
from tests.waiting import wait_until

PORTS = range(20_000, 32_000)
"""Below those that systems give to connections: no connection gets a scheduler's before it listens there (again)."""
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["distributed.cli.dask_scheduler", "tests.batch.farm_worker"])
Process = multiprocessing.context.ForkServerProcess


class Farm:
    """Starts processes, which end with the test."""

    def __init__(self) -> None:
        self._started: list[Process] = []

    def start(self, function: Callable[..., object], *arguments: Any) -> Process:
        process = FORKS.Process(target=function, args=arguments, daemon=True)
        process.start()
        self._started.append(process)
        return process

    def scheduler(self, port: int = 0, ttl_s: float = 60.0, *options: str) -> tuple[Process, int]:
        """A scheduler that answers, at ``port`` or any, and its port."""
        port = port or next(each for each in random.sample(PORTS, 100) if not answers(each))
        scheduler = self.start(farm_worker.schedule, port, ttl_s, options)
        wait_until(lambda: answers(port) or not scheduler.is_alive(), f"a scheduler at port {port}")
        assert scheduler.is_alive()
        return scheduler, port

    def workers(self, address: str, *kinds: str) -> None:
        for kind in kinds:
            self.start(farm_worker.work, kind, address)

    def close(self) -> None:
        for process in self._started:
            process.kill()
            process.join()


def answers(port: int) -> bool:
    """Whether somebody listens there, on this machine."""
    try:
        socket.create_connection(("127.0.0.1", port)).close()
    except ConnectionRefusedError:
        return False
    return True


def plan_of(folder: Path, *names: str) -> BatchPlan:
    jobs = []
    for name in names:
        scene = folder / "scenes" / name
        scene.mkdir(parents=True)
        if name == "dark":
            (scene / "dark").touch()
        jobs.append(SceneJob(name, folder / "out" / name, LiftRequest(scene=scene)))
    return BatchPlan(folder / "out", tuple(jobs))


def run(plan: BatchPlan, farm_options: FarmOptions) -> ExitCode:
    with Interrupts() as interrupts, interrupts.deferred():
        return run_batch(plan, farm_options, interrupts)


def rows_of(plan: BatchPlan) -> dict[str, dict[str, str]]:
    with (plan.output / "table.csv").open() as file:
        return {row["scene"]: row for row in csv.DictReader(file)}


def hellos(lift: Path) -> list[dict[str, object]]:
    text = (lift / "events.jsonl").read_text() if (lift / "events.jsonl").exists() else ""
    whole = text.split("\n")[:-1]  # an engine may be writing the last line
    return [event for line in whole if (event := json.loads(line))["event"] == "hello"]


def pause(job: SceneJob) -> Path:
    """Let a lift wait in the middle of its first run, until the test ends it or deletes this file."""
    file = job.request.scene / "pause"
    file.touch()
    return file


def in_the_middle(lift: Path) -> int:
    """Wait until a lift pauses, and return the number of the worker's process."""
    events = lift / "events.jsonl"
    wait_until(
        lambda: events.exists() and events.read_text().count('"event": "progress"') > farm_worker.PAUSE_AFTER, lift
    )
    status = Path(f"/proc/{hellos(lift)[-1]['pid']}/status").read_text()
    return int(status.split("PPid:")[1].split()[0])


def meanwhile(act: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=act)
    thread.start()
    return thread
