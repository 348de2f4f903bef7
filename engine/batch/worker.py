"""A Dask worker that runs this engine: one piece of work at a time."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import sys
import tempfile
import threading
from typing import Any

from ..errors import ExitCode, PlgsError, lacks_part
from ..job.main_memory import main_memory
from ..job.stop import await_end
from ..job.system import usable_cpus
from .piece import GIGABYTES, THREADS, engine_tag

PATIENCE_S = 60.0
"""Seconds without a scheduler after which a worker ends. One that is restarted meanwhile finds its workers again."""


def require_dask(name: str = "distributed") -> Any:
    """The module. Raises PlgsError where it is not installed."""
    try:
        return __import__(name)
    except ModuleNotFoundError as error:
        raise lacks_part("batches need Dask, which this engine lacks", sys.executable, "farm") from error


def is_address(text: str) -> bool:
    """Whether it may be a scheduler's. Dask waits long for what is none, and ends in errors of its own."""
    return re.fullmatch(r"[a-z]+://[^\s/]+:[0-9]{1,5}", text) is not None


def resources(gigabytes: float, threads: int) -> dict[str, float]:
    """What a worker offers. Pieces ask for the engine's tag, so that a worker with another engine gets none."""
    return {engine_tag(): 1.0, GIGABYTES: gigabytes, THREADS: float(threads)}


def run_worker(
    address: str,
    gigabytes: float = 0.0,
    threads: int = 0,
    parent_pipe: int | None = None,
    patience_s: float = PATIENCE_S,
) -> ExitCode:
    """Work for the scheduler at ``address`` until it is gone for ``patience_s``. 0 stands for all memory and threads.

    The engines that it started end with it, at their last checkpoint. Raises PlgsError.
    """
    require_dask()
    fix = "Give the address that the scheduler says, such as tcp://machine:8786."
    if not is_address(address):
        raise PlgsError("is not the address of a scheduler", address, fix)
    if not gigabytes:
        memory = main_memory()
        gigabytes = memory.total / 1e9 if memory is not None else 1.0
    offered = resources(gigabytes, threads or usable_cpus())
    with tempfile.TemporaryDirectory(prefix="plgs-worker-", ignore_cleanup_errors=True) as scratch:
        if parent_pipe is not None:
            threading.Thread(target=_end_with_parent, args=(parent_pipe, scratch), daemon=True).start()
        try:
            asyncio.run(_serve(address, offered, patience_s, scratch))
        except (OSError, ValueError) as error:
            raise PlgsError(f"no scheduler is there ({error})", address, fix) from error
    return ExitCode.FINISHED


def _end_with_parent(pipe: int, scratch: str) -> None:
    await_end(pipe)
    shutil.rmtree(scratch, ignore_errors=True)
    os._exit(ExitCode.CANCELLED)


async def _serve(address: str, offered: dict[str, float], patience_s: float, scratch: str) -> None:
    """A worker whose scheduler is gone closes; a new one then waits for the scheduler's return."""
    from distributed import Worker

    while True:
        worker = Worker(
            address, nthreads=1, resources=offered, memory_limit=0, local_directory=scratch,
            death_timeout=patience_s, dashboard=False, name=f"plgs-{os.getpid()}-{os.urandom(3).hex()}",
        )  # fmt: skip
        try:
            await worker
        except TimeoutError:
            return
        await worker.finished()
