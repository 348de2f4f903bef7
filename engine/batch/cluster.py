"""Connect to where a batch runs: own workers on this machine, an existing scheduler, or Slurm; and run a worker."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import ssl
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import Any

from ..errors import ExitCode, PlgsError, lacks_part
from ..job.process import ROOT, EngineProcess, engine_call
from ..job.system import main_memory, usable_cpus
from ..job.task import await_end, last_lines
from .piece import GIGABYTES, THREADS, engine_tag

NO_WORKER_S = 5.0
"""Seconds after which a scheduler without workers is an error."""
RETURN_S = 60.0
"""Seconds that a lost scheduler and its workers may take to come back."""
CONNECT_S = 5.0
"""Seconds within which a scheduler must answer."""
END_S = 5.0
"""Seconds that our own workers may take to end without being killed."""


@dataclass(frozen=True)
class FarmOptions:
    """Where a batch runs: ``workers`` on this machine, unless the address of a ``scheduler``, or ``slurm`` with its
    options, is given. ``gigabytes`` and ``threads`` are those of one worker. Without scheduler or Slurm nothing listens
    on the network; with one of them ``tls`` keeps others out. Slurm's jobs write to files in the folder ``logs``."""

    workers: int = 1
    scheduler: str = ""
    slurm: Mapping[str, str] | None = None
    gigabytes: float = 1.0
    threads: int = 1
    tls: Tls | None = None
    logs: Path | None = None


@dataclass
class Farm:
    """A connection to workers: Dask's ``client``, the scheduler's ``address``. ``own`` are workers that this process
    started; one that ends is restarted. ``slurm`` is dask-jobqueue's cluster, if Slurm starts the workers."""

    client: Any
    address: str
    options: FarmOptions
    own: list[EngineProcess] = field(default_factory=list)
    slurm: Any = None

    def tend(self) -> None:
        """Restart our own workers that have ended. Raises PlgsError if one cannot start."""
        for number, worker in enumerate(self.own):
            if worker.exit_code() is not None:
                worker.close()
                self.own[number] = _start_worker(self.address, self.options)

    def use_fewer(self, name: str) -> bool:
        """Close one of our own workers: ``name`` if it is ours, else any. Returns False if only one is left."""
        if len(self.own) < 2:
            return False
        number = next((k for k, worker in enumerate(self.own) if f"plgs-{worker.pid}-" in name), -1)  # -1: any
        self.own.pop(number).close()
        return True

    def workers(self) -> dict[str, dict[str, Any]]:
        """Return Dask's facts about the workers that run the same engine as this process, by address."""
        known = self.client.scheduler_info(n_workers=-1)["workers"]  # -1: all of them
        return {address: worker for address, worker in known.items() if engine_tag() in worker.get("resources", {})}

    def largest(self) -> float:
        """The memory of the largest worker in GB. On Slurm all workers have the same, known before they start."""
        if self.options.slurm is not None:
            return self.options.gigabytes
        return max((worker["resources"].get(GIGABYTES, 0.0) for worker in self.workers().values()), default=0.0)

    def refuse_dead_jobs(self) -> None:
        """Raise PlgsError if Slurm refuses our jobs, or all of them have ended; dask-jobqueue would wait forever."""
        if self.slurm is None:
            return
        refusals, jobs = self.slurm.refusals, [job.job_id for job in self.slurm.workers.values() if job.job_id]
        if not jobs and not refusals:  # they are being submitted
            return
        if jobs:
            try:
                command = ["squeue", "--noheader", "--format=%i", "--jobs", ",".join(jobs)]
                asked = subprocess.run(command, capture_output=True, text=True, timeout=CONNECT_S, check=False)
            except (OSError, subprocess.TimeoutExpired):  # not known
                return
            # Slurm forgets a job some minutes after its end.
            if asked.stdout.strip() or (asked.returncode and "Invalid job id" not in asked.stderr):
                return
        logs = sorted(self.options.logs.glob("*.log"), key=os.path.getmtime) if self.options.logs else []
        said = [line for log in logs[-1:] for line in last_lines(log, 1)]
        what = f"no Slurm job runs a worker ({[*refusals, *said, 'they wrote nothing'][0]})"
        fix = "Correct the options of --slurm or the machines, then start the batch again."
        raise PlgsError("slurm-jobs", what, self.options.logs or "sbatch", fix, option="--slurm")


@contextmanager
def opened(farm_options: FarmOptions) -> Iterator[Farm]:
    """Connect, and start the workers that the options ask for. Raises PlgsError, also if no worker comes within
    NO_WORKER_S (on Slurm, a job may wait in the queue for any time)."""
    distributed = require_dask()
    with ExitStack() as stack:
        cluster = None
        if farm_options.scheduler:
            address = farm_options.scheduler
        elif farm_options.slurm is not None:
            cluster = stack.enter_context(slurm_cluster(farm_options))
            cluster.adapt(minimum=farm_options.workers, maximum=farm_options.workers)  # a job that ends is replaced
            address = cluster.scheduler_address
        else:
            local = distributed.LocalCluster(  # only a scheduler: `_start_worker` starts the workers
                n_workers=0, host=LOOPBACK, protocol="tcp://", dashboard_address=f"{LOOPBACK}:0", silence_logs=50
            )
            address = stack.enter_context(local).scheduler_address
        farm = Farm(_client(address, farm_options.tls), address, farm_options, slurm=cluster)
        stack.callback(_close, farm)
        if not farm_options.scheduler and farm_options.slurm is None:
            farm.own += [_start_worker(address, farm_options) for _ in range(farm_options.workers)]
        if farm_options.slurm is None:
            wait_for_workers(farm, NO_WORKER_S if farm_options.scheduler else 6 * NO_WORKER_S)  # ours start now
        yield farm


def _client(address: str, tls: Tls | None) -> Any:
    distributed = require_dask()
    fix = "Start one (dask scheduler), or give its address, such as tcp://machine:8786."
    security = security_for(address, tls, fix)
    try:
        return distributed.Client(address, timeout=CONNECT_S, set_as_default=False, security=security)
    except (OSError, ValueError, RuntimeError) as error:
        raise PlgsError("no-scheduler", "no scheduler answers", address, fix, option="--scheduler") from error


def reconnected(farm: Farm) -> None:
    """Connect again to a scheduler that was restarted, and wait for its workers. Raises PlgsError after RETURN_S."""
    with suppress(Exception):  # the old connection is broken, and it does not matter how
        farm.client.close(timeout=1)
    give_up = time.monotonic() + RETURN_S
    while True:
        try:
            farm.client = _client(farm.address, farm.options.tls)
            return wait_for_workers(farm, RETURN_S)
        except PlgsError:
            if time.monotonic() > give_up:
                raise
            time.sleep(1.0)


def wait_for_workers(farm: Farm, seconds: float) -> None:
    """Raise PlgsError if no worker with this engine is there within this many seconds."""
    give_up = time.monotonic() + seconds
    while not farm.workers():
        if time.monotonic() > give_up:
            known = farm.client.scheduler_info(n_workers=-1)["workers"].values()
            names = {name for worker in known for name in worker.get("resources", {})}
            others = sorted(name for name in names if name.startswith("plgs-"))
            has = f"only workers of {', '.join(others)}, not of {engine_tag()}" if others else "no workers"
            fix = f"Start some with this engine: python -m engine worker {farm.address}"
            fix = fix if farm.slurm is None else "See with squeue why their jobs do not run."
            raise PlgsError("no-worker", f"the scheduler has {has}", farm.address, fix, option="--scheduler")
        farm.tend()
        time.sleep(0.2)


def _start_worker(address: str, farm_options: FarmOptions) -> EngineProcess:
    options = ["--memory", str(farm_options.gigabytes), "--threads", str(farm_options.threads), "--stay-with-parent"]
    return EngineProcess([*engine_call(Path(sys.executable)), "worker", address, *options])


def _close(farm: Farm) -> None:
    with suppress(Exception):  # a scheduler that is gone
        farm.client.close(timeout=2)
    for worker in farm.own:
        worker.close()  # a worker whose pipe closes ends, and clears its scratch folder
    give_up = time.monotonic() + END_S
    while time.monotonic() < give_up and any(worker.exit_code() is None for worker in farm.own):
        time.sleep(0.05)
    for worker in farm.own:
        worker.kill()


def slurm_cluster(farm_options: FarmOptions) -> Any:
    """Return dask-jobqueue's cluster, one worker a job; its ``refusals`` are sbatch's messages. Raises PlgsError if
    Slurm is missing."""
    jobqueue, distributed = require_dask("dask_jobqueue"), require_dask()
    assert farm_options.slurm is not None
    if shutil.which("sbatch") is None:
        what = "Slurm is not installed here"
        raise PlgsError("no-slurm", what, "sbatch", "Start the batch on a node of the cluster.")
    offered = ",".join(
        f"{name}={value:g}" for name, value in resources(farm_options.gigabytes, farm_options.threads).items()
    )
    options: dict[str, Any] = {name: value for name, value in farm_options.slurm.items() if value}
    for name, value in options.items():
        if not value.isprintable() or " " in value:
            fix = f"Give --{name} without blanks or line breaks."
            raise PlgsError("slurm-option", f"{value!r} cannot be used in a Slurm job", name, fix, option=f"--{name}")
    if farm_options.tls is not None:
        options |= {"security": farm_options.tls.security(in_a_shell=True), "protocol": "tls://"}
    prologue = ["unset PYTHONHOME", f"export PYTHONNOUSERSITE=1 PYTHONPATH={quote(str(ROOT))}"]
    if farm_options.logs is not None:
        farm_options.logs.mkdir(parents=True, exist_ok=True)
        logs = quote(str(farm_options.logs))
        prologue.append(f"if [ -w {logs} ]; then exec >{logs}/${{SLURM_JOB_ID:-$$}}.log 2>&1; fi")  # a node may lack it
    refusals: list[str] = []
    of_slurm: Any = jobqueue.SLURMCluster.job_cls

    class Job(of_slurm):
        async def start(self) -> None:
            try:
                await super().start()
            except (OSError, RuntimeError, ValueError) as error:
                refusals.append([line for line in str(error).splitlines() if line.strip()][-1])  # sbatch's own words
                self.status = distributed.Status.running  # else Dask cannot close it

    try:
        cluster = jobqueue.SLURMCluster(
            job_cls=Job,
            cores=1,  # one piece at a time; its engine uses all the threads
            job_cpu=farm_options.threads,
            processes=1,
            memory=f"{farm_options.gigabytes:g}GB",
            python=f"{quote(sys.executable)} -P",  # nothing is imported from the folder where a job starts
            nanny=False,
            worker_extra_args=["--resources", offered, "--no-dashboard"],
            job_script_prologue=prologue,
            job_directives_skip=["--mem"] if not farm_options.gigabytes else [],  # else Slurm's default
            **options,
        )
    except (OSError, ValueError) as error:
        what = f"Slurm cannot be used ({error})"
        raise PlgsError("bad-slurm", what, "sbatch", "Correct the options of --slurm.") from error
    cluster.refusals = refusals
    return cluster


LOOPBACK = "127.0.0.1"
PATIENCE_S = 60.0
"""Seconds without a scheduler after which a worker ends. A scheduler restarted before that finds its workers again."""


def require_dask(name: str = "distributed") -> Any:
    """Import Dask's module ``name``. Raises PlgsError if it is not installed."""
    try:
        return __import__(name)
    except ModuleNotFoundError as error:
        raise lacks_part("batches need Dask, which this engine lacks", sys.executable, "farm") from error


@dataclass(frozen=True)
class Tls:
    """The files for encrypted connections of Dask: the certificate of the authority, ``ca``, that signed those of all
    machines, and this machine's own ``certificate`` with its key (PEM)."""

    ca: Path
    certificate: Path

    def security(self, *, in_a_shell: bool = False) -> Any:
        """Dask's security settings; ``in_a_shell`` quotes paths for a job script. Raises PlgsError for bad files."""
        ca, own = str(self.ca), str(self.certificate)
        try:
            ssl.create_default_context(cafile=ca).load_cert_chain(own)
        except (OSError, ssl.SSLError) as error:
            fix = "Give PEM files: --tls-ca with a certificate, --tls-certificate with a certificate and its key."
            raise PlgsError("bad-tls", f"TLS cannot be used ({error.strerror or error})", own, fix) from error
        roles = ("client", "scheduler", "worker")
        files = {f"tls_{role}_{part}": own for role in roles for part in ("cert", "key")}
        of_dask: Any = require_dask().Security

        class Quoted(of_dask):  # dask-jobqueue writes the paths into a script as they are
            def get_tls_config_for_role(self, role: str) -> dict[str, Any]:
                files = super().get_tls_config_for_role(role).items()
                return {name: quote(value) if role == "worker" and value else value for name, value in files}

        return (Quoted if in_a_shell else of_dask)(tls_ca_file=ca, require_encryption=True, **files)


def security_for(address: str, tls: Tls | None, fix: str) -> Any:
    """Dask's settings for an address, None without ``tls``. Raises PlgsError, with ``fix``, for a bad input."""
    if re.fullmatch(r"[a-z]+://[^\s/]+:[0-9]{1,5}", address) is None:  # Dask waits long, and ends with its own errors
        raise PlgsError("scheduler-address", "is not the address of a scheduler", address, fix)
    if tls is None:
        return None
    if not address.startswith("tls://"):
        fix = "Start the scheduler with --tls-ca-file, --tls-cert and --tls-key, and give the address that it prints."
        raise PlgsError("address-without-tls", "is not an address with TLS, which begins with tls://", address, fix)
    return tls.security()


def resources(gigabytes: float, threads: int) -> dict[str, float]:
    """Return a worker's resources by name: memory, threads, and the engine's tag: other engines get no pieces."""
    return {engine_tag(): 1.0, GIGABYTES: gigabytes, THREADS: float(threads)}


def run_worker(
    address: str,
    *,
    gigabytes: float = 0.0,
    threads: int = 0,
    parent_pipe: int | None = None,
    patience_s: float = PATIENCE_S,
    tls: Tls | None = None,
) -> ExitCode:
    """Work for the scheduler at ``address`` until it has been gone for ``patience_s`` seconds. ``gigabytes`` and
    ``threads`` of 0 mean all. It also ends with the pipe ``parent_pipe``. A worker of a scheduler on this machine
    listens on this machine only. The engines that the worker started end with it, at their last checkpoint. Raises
    PlgsError if the scheduler or ``tls`` cannot be used."""
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
            raise PlgsError("scheduler-unreachable", f"there is no scheduler ({error})", address, fix) from error
    return ExitCode.FINISHED


def _end_with_parent(pipe: int, scratch: str) -> None:
    await_end(pipe)
    shutil.rmtree(scratch, ignore_errors=True)
    os._exit(ExitCode.CANCELLED)  # sys.exit would end only this thread


async def _serve(address: str, offered: dict[str, float], patience_s: float, scratch: str, security: Any) -> None:
    """Serve a scheduler until it is gone, then wait ``patience_s`` seconds with a new worker for it to come back."""
    from distributed import Worker

    host = address.rpartition("//")[2].rpartition(":")[0].strip("[]")
    is_here = host in ("localhost", "::1") or host.startswith("127.")
    while True:
        worker = Worker(  # one piece at a time; no memory limit, as Dask would not see the engine's memory
            address, nthreads=1, resources=offered, memory_limit=0, local_directory=scratch,
            death_timeout=patience_s, dashboard=False, host=LOOPBACK if is_here else None,
            security=security, name=f"plgs-{os.getpid()}-{os.urandom(3).hex()}",
        )  # fmt: skip
        try:
            await worker
        except TimeoutError:  # no scheduler for `patience_s`
            return
        await worker.finished()
