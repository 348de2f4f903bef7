"""A farm on this machine: schedulers, workers and batches in processes of their own, and what they leave in folders.

Its processes are forks of one that has imported Dask and the engine, which takes three seconds each time otherwise.
"""

from __future__ import annotations

import csv
import json
import multiprocessing
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from engine.batch import BatchPlan, SceneJob, run_batch
from engine.batch.cluster import Place
from engine.errors import ExitCode
from engine.job import LiftRequest
from engine.job.terminal import Interrupts
from tests.batch import farm_worker

PATIENCE_S = 60.0
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
        if not port:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                port = free.getsockname()[1]
        scheduler = self.start(farm_worker.schedule, port, ttl_s, options)
        give_up = time.monotonic() + PATIENCE_S
        while True:
            try:
                socket.create_connection(("127.0.0.1", port)).close()
                return scheduler, port
            except ConnectionRefusedError:
                assert time.monotonic() < give_up and scheduler.is_alive()
                time.sleep(0.1)

    def workers(self, address: str, *kinds: str) -> None:
        for kind in kinds:
            self.start(farm_worker.work, kind, address)

    def close(self) -> None:
        for process in self._started:
            process.kill()
            process.join()


def plan_of(folder: Path, *names: str) -> BatchPlan:
    jobs = []
    for name in names:
        scene = folder / "scenes" / name
        scene.mkdir(parents=True)
        if name == "dark":
            (scene / "dark").touch()
        jobs.append(SceneJob(name, folder / "out" / name, LiftRequest(scene=scene)))
    return BatchPlan(folder / "out", tuple(jobs))


def run(plan: BatchPlan, place: Place) -> ExitCode:
    with Interrupts() as interrupts, interrupts.deferred():
        return run_batch(plan, place, interrupts)


def rows_of(plan: BatchPlan) -> dict[str, dict[str, str]]:
    with (plan.output / "table.csv").open() as file:
        return {row["scene"]: row for row in csv.DictReader(file)}


def hellos(lift: Path) -> list[dict[str, object]]:
    lines = (lift / "events.jsonl").read_text().splitlines() if (lift / "events.jsonl").exists() else []
    return [told for line in lines if (told := json.loads(line))["event"] == "hello"]


def in_the_middle(lift: Path, runs: int = 1) -> int:
    """Wait until a lift trains, in its run of this number, and return the number of the worker's process."""
    give_up = time.monotonic() + PATIENCE_S
    while not _is_training(lift, runs):
        assert time.monotonic() < give_up
        time.sleep(0.02)
    status = Path(f"/proc/{hellos(lift)[-1]['pid']}/status").read_text()
    return int(status.split("PPid:")[1].split()[0])


def _is_training(lift: Path, runs: int) -> bool:
    if len(hellos(lift)) < runs:
        return False
    *_, latest = (lift / "events.jsonl").read_text().split('"event": "hello"')
    return latest.count('"event": "progress"') > 10


def meanwhile(act: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=act)
    thread.start()
    return thread
