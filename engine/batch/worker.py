"""A Dask worker that runs this engine: one piece of work at a time."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import ssl
import sys
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import ExitCode, PlgsError, lacks_part
from ..job.main_memory import main_memory
from ..job.stop import await_end
from ..job.system import usable_cpus
from .piece import GIGABYTES, THREADS, engine_tag

LOOPBACK = "127.0.0.1"
PATIENCE_S = 60.0
"""Seconds without a scheduler after which a worker ends. A scheduler restarted before that finds its workers again."""


def require_dask(name: str = "distributed") -> Any:
    """The module. Raises PlgsError if it is not installed."""
    try:
        return __import__(name)
    except ModuleNotFoundError as error:
        raise lacks_part("batches need Dask, which this engine lacks", sys.executable, "farm") from error


def is_address(text: str) -> bool:
    """Whether this may be a scheduler's address. For others, Dask waits long and ends with its own errors."""
    return re.fullmatch(r"[a-z]+://[^\s/]+:[0-9]{1,5}", text) is not None


def is_here(address: str) -> bool:
    """Whether an address is only for programs on this machine."""
    host = address.rpartition("//")[2].rpartition(":")[0].strip("[]")
    return host in ("localhost", "::1") or host.startswith("127.")


@dataclass(frozen=True)
class Tls:
    """What makes Dask's connections private: the certificate of the authority, ``ca``, that signed those of all
    machines, and this machine's own ``certificate`` with its key (PEM)."""

    ca: Path
    certificate: Path

    def security(self) -> Any:
        """Dask's settings. Raises PlgsError for files that cannot be used."""
        ca, own = str(self.ca), str(self.certificate)
        try:
            ssl.create_default_context(cafile=ca).load_cert_chain(own)
        except (OSError, ssl.SSLError) as error:
            fix = "Give PEM files: --tls-ca with a certificate, --tls-certificate with a certificate and its key."
            raise PlgsError(f"TLS cannot be used ({error.strerror or error})", own, fix) from error
        roles = ("client", "scheduler", "worker")
        files = {f"tls_{role}_{part}": own for role in roles for part in ("cert", "key")}
        return require_dask().Security(tls_ca_file=ca, require_encryption=True, **files)


def security_for(address: str, tls: Tls | None, fix: str) -> Any:
    """Dask's settings for an address, or None. Raises PlgsError if they do not fit, or if it is no address."""
    if not is_address(address):
        raise PlgsError("is not the address of a scheduler", address, fix)
    if tls is None:
        return None
    if not address.startswith("tls://"):
        fix = "Start the scheduler with --tls-ca-file, --tls-cert and --tls-key, and give the address that it prints."
        raise PlgsError("is not an address with TLS, which begins with tls://", address, fix)
    return tls.security()


def resources(gigabytes: float, threads: int) -> dict[str, float]:
    """What a worker offers. Pieces require the engine's tag, so that a worker with a different engine gets none."""
    return {engine_tag(): 1.0, GIGABYTES: gigabytes, THREADS: float(threads)}


def run_worker(
    address: str,
    gigabytes: float = 0.0,
    threads: int = 0,
    parent_pipe: int | None = None,
    patience_s: float = PATIENCE_S,
    tls: Tls | None = None,
) -> ExitCode:
    """Work for the scheduler at ``address`` until it has been gone for ``patience_s``. 0 means all memory and threads.
    A worker of a scheduler on this machine listens on this machine only.

    The engines that the worker started end with it, at their last checkpoint. Raises PlgsError.
    """
    require_dask()
    fix = "Give the address that the scheduler prints, such as tcp://machine:8786."
    security = security_for(address, tls, fix)
    if not gigabytes:
        memory = main_memory()
        gigabytes = memory.total / 1e9 if memory is not None else 1.0
    offered = resources(gigabytes, threads or usable_cpus())
    with tempfile.TemporaryDirectory(prefix="plgs-worker-", ignore_cleanup_errors=True) as scratch:
        if parent_pipe is not None:
            threading.Thread(target=_end_with_parent, args=(parent_pipe, scratch), daemon=True).start()
        try:
            asyncio.run(_serve(address, offered, patience_s, scratch, security))
        except (OSError, ValueError, RuntimeError) as error:
            raise PlgsError(f"there is no scheduler ({error})", address, fix) from error
    return ExitCode.FINISHED


def _end_with_parent(pipe: int, scratch: str) -> None:
    await_end(pipe)
    shutil.rmtree(scratch, ignore_errors=True)
    os._exit(ExitCode.CANCELLED)


async def _serve(address: str, offered: dict[str, float], patience_s: float, scratch: str, security: Any) -> None:
    """A worker whose scheduler is gone closes; a new one then waits for the scheduler to come back."""
    from distributed import Worker

    while True:
        worker = Worker(
            address, nthreads=1, resources=offered, memory_limit=0, local_directory=scratch,
            death_timeout=patience_s, dashboard=False, host=LOOPBACK if is_here(address) else None,
            security=security, name=f"plgs-{os.getpid()}-{os.urandom(3).hex()}",
        )  # fmt: skip
        try:
            await worker
        except TimeoutError:
            return
        await worker.finished()
