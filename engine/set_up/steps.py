"""The steps of a set-up, from a base Python to an engine that answers.

What a step finished is noted in the environment. A set-up that was cancelled, killed or cut off continues there.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import PlgsError
from ..job import EventWriter, StopSignal, write_atomically
from ..job.environment import (
    COMPLETE,
    constraints_path,
    environment_name,
    environments_folder,
    hashes_path,
    is_complete,
    needed_packages,
    pinned_versions,
    python_in,
)
from ..job.handshake import EngineAnswer
from ..job.lock import FileLock, is_locked
from ..job.process import ROOT, clean_environment, engine_call
from . import programs
from .base_python import PROBE, BasePython, candidates, judge
from .environments import LOCK, LOG, Notes, bytes_in, empty_trash, throw_away
from .pip_wheel import fetch_pip

STAGE = "set-up"
LABELS = (
    "Looking for a Python",
    "Making the environment",
    "Installing torch",
    "Installing the other packages",
    "Compiling for this computer",
    "Asking the engine",
)
PARTS = 1000
"""How many parts the progress of the whole set-up is counted in."""
_ANSWER_S = 10.0
"""Seconds within which a Python must answer. The first answer from a cold disk takes a few."""
_POLL_S = 0.05
_MEASURE_S = 1.0
_GIGABYTE = 10**9
NEEDED_BYTES = {"cpu": 5 * _GIGABYTE, "cuda": 15 * _GIGABYTE}
"""Free bytes on the disk for the environment, for what is unpacked meanwhile and for pip's own cache, rounded up."""
_INSTALLED_BYTES = {"cpu": 1.8 * _GIGABYTE, "cuda": 7.0 * _GIGABYTE}
"""Bytes that the installed packages take on the disk."""
_INSTALLED, _COMPILED = 0.8, 0.98
"""Parts of the whole that are done when the packages are installed, and when the kernels are compiled."""
_SYNC = "import os; getattr(os, 'sync', lambda: None)()"


@dataclass(frozen=True)
class SetUpRequest:
    """``base_python`` None takes the first that can make environments. ``torch_build`` is "cpu" or "cuda". An empty
    ``index_url`` lets packages come from where pip is configured to look.
    """

    base_python: Path | None = None
    torch_build: str = "cpu"
    index_url: str = ""


class SetUp:
    """One set-up. `run` does all of it."""

    def __init__(
        self,
        request: SetUpRequest,
        events: EventWriter,
        stop: StopSignal,
        root: Path = ROOT,
        folder: Path | None = None,
    ) -> None:
        """``folder`` holds environments, log and lock; None: the user's cache. ``root`` holds engine/ and
        requirements/."""
        self.request, self.root = request, root
        self.folder = folder or environments_folder()
        self._events, self._stop = events, stop
        self._environment: Path | None = None
        self._done, self._measured_at = 0.0, 0.0
        self._step, self._label = 0, ""
        self._lock: FileLock | None = None

    @property
    def log_path(self) -> Path:
        """The output of all programs."""
        return self.folder / LOG

    def run(self) -> Path:
        """Do all steps and return the environment's Python. Raises PlgsError; Cancelled when it was asked to stop."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            while is_locked(self.folder / LOCK):
                self._tell(1, "Another set-up is running")
                self._pause()
            with FileLock(self.folder / LOCK) as self._lock:
                self.log_path.write_bytes(b"")
                return self._do_steps()
        except OSError as error:
            fix = "Make room on the disk, or let PLGS write there, then set up the engine again."
            where = error.filename or self.folder
            raise PlgsError("set-up-stopped", f"the set-up was stopped ({error.strerror})", where, fix) from error

    def _do_steps(self) -> Path:
        base = self._find_base_python()
        environment = self.folder / environment_name(self.root, base.version)
        if not self._is_ready(environment):
            self._check_disk()
            notes = self._make_environment(environment, base)
            self._install_packages(environment, base, notes)
            self._compile_kernels(environment)
            self._finish(environment)
        empty_trash(self.folder)
        return python_in(environment)

    def _find_base_python(self) -> BasePython:
        versions = pinned_versions(self.root)
        if not versions:
            what = "the requirements are missing"
            raise PlgsError("no-requirements", what, self.root / "requirements", "Install PLGS again.")
        refused = []
        for python in candidates(self.request.base_python, versions):
            self._tell(1, str(python))
            try:
                verdict = judge(*self._run([python, "-I", "-c", PROBE], limit_s=_ANSWER_S), versions)
            except PlgsError as error:
                verdict = error.what
            if isinstance(verdict, BasePython):
                return verdict
            refused.append(f"{python} {verdict}")
        self._log("\n".join(refused))
        wanted = " or ".join(f"{major}.{minor}" for major, minor in versions)
        fix = f"Install Python {wanted} with venv and pip, or name one in the preferences."
        what = f"no Python can make the engine's environment ({'; '.join(refused[:3])})"
        raise PlgsError("no-python", what, self.log_path, fix)

    def _is_ready(self, environment: Path) -> bool:
        """Whether nothing is left to do. A complete environment that does not answer, or was made with another torch,
        is thrown away.
        """
        if not is_complete(environment):
            return False
        notes = Notes.read(environment)
        if notes is not None and notes.torch_build == self.request.torch_build:
            with suppress(PlgsError):
                if not self._ask(python_in(environment)).missing:
                    return True
        throw_away(environment, self.folder)
        return False

    def _check_disk(self) -> None:
        needed, free = NEEDED_BYTES[self.request.torch_build], shutil.disk_usage(self.folder).free
        if free < needed:
            what = f"the disk has {free / _GIGABYTE:.1f} GB free, but the engine needs {needed / _GIGABYTE:.0f} GB"
            raise PlgsError("disk-full", what, self.folder, "Make room, then set up the engine again.")

    def _make_environment(self, environment: Path, base: BasePython) -> Notes:
        self._tell(2, f"Python {base.version[0]}.{base.version[1]}")
        self._environment = environment
        notes = Notes.read(environment)
        is_sound = notes is not None and not notes.installing and python_in(environment).exists()
        if notes is not None and is_sound and notes.torch_build == self.request.torch_build:
            self._log(f"Continuing {environment}, which has: {', '.join(notes.done)}")
            return notes
        throw_away(environment, self.folder)
        options = [] if base.has_pip else ["--without-pip"]
        output, code = self._run([base.python, "-I", "-m", "venv", *options, environment])
        if code == 0 and not base.has_pip:
            wheel = fetch_pip(environment, self.request.index_url, self._stop.check)
            output, code = self._run(programs.install_pip_command(python_in(environment), wheel))
        if code != 0:
            what = f"{base.python} could not make an environment ({programs.complaint(output)})"
            raise PlgsError("environment-failed", what, self.log_path, "Name another Python in the preferences.")
        notes = Notes(self.request.torch_build)
        notes.write(environment)
        return notes

    def _install_packages(self, environment: Path, base: BasePython, notes: Notes) -> None:
        """Install torch alone, then the packages that have hashes, then all. The last call finds these installed and
        adds what torch needs of CUDA.
        """
        needed = needed_packages(self.root, base.version)
        pins = {name: f"{name}=={pin}" if pin else name for name, pin in needed.items()}
        constraints, python = constraints_path(self.root, base.version), python_in(environment)
        build = self.request.torch_build
        self._tell(3)
        options = programs.torch_options(self.request.index_url, build)
        command = programs.install_command(python, [pins["torch"]], constraints, options)
        self._install("torch", environment, command, notes)
        self._tell(4)
        hashes = hashes_path(self.root, base.version)
        if hashes.exists():
            self._install("packages", environment, programs.install_hashed_command(python, hashes), notes)
        command = programs.install_command(python, list(pins.values()), constraints)
        self._install("what is left", environment, command, notes)

    def _install(self, step: str, environment: Path, command: Sequence[str | Path], notes: Notes) -> None:
        if step in notes.done:
            return
        temporary = environment / "tmp"
        throw_away(temporary, self.folder)
        temporary.mkdir()

        def read_line(line: str) -> None:
            if line.startswith(programs.INSTALLING):
                notes.installing = True
                notes.write(environment)
            if news := programs.news_of_pip(line):
                self._tell(self._step, news)

        variables = programs.pip_environment(temporary, self.request.index_url)
        output, code = self._run(command, environment=variables, read_line=read_line)
        if code != 0:
            fix = "Check the connection and the disk, then set up the engine again: it continues there."
            what = f"pip could not install {step} ({programs.complaint(output)})"
            raise PlgsError("pip-failed", what, self.log_path, fix)
        throw_away(temporary, self.folder)
        notes.done.append(step)
        notes.installing = False
        notes.write(environment)

    def _compile_kernels(self, environment: Path) -> None:
        """Compile what a lift runs. This is also the best test that the engine works here."""
        self._done = _INSTALLED
        self._tell(5, "half a minute")
        output, code = self._run([*engine_call(python_in(environment), self.root), "warm-up"], cwd=self.root)
        if code != 0:
            what = f"the engine does not work in its new environment ({programs.complaint(output)})"
            fix = "Remove the engine, then set it up again. The log has the details."
            raise PlgsError("engine-broken", what, self.log_path, fix)

    def _finish(self, environment: Path) -> None:
        answer = self._ask(python_in(environment))
        if answer.missing:
            fix = "Remove the engine, then set it up again."
            raise PlgsError("lacks-modules", f"the new environment lacks {', '.join(answer.missing)}", environment, fix)
        # The packages reach the disk before the mark: after a power cut no incomplete environment is marked complete.
        self._run([python_in(environment), "-I", "-c", _SYNC])
        write_atomically(environment / COMPLETE, f"{answer.python}\n")

    def _ask(self, python: Path) -> EngineAnswer:
        """The answer of the engine in ``python``. Raises PlgsError when there is none."""
        self._done = _COMPILED
        self._tell(6)
        output, code = self._run([*engine_call(python, self.root), "handshake"], cwd=self.root, limit_s=_ANSWER_S)
        answer = EngineAnswer.from_line(output.splitlines()[-1]) if code == 0 and output else None
        if answer is None:
            fix = "Remove the engine, then set it up again."
            raise PlgsError("silent", f"the engine does not answer ({programs.complaint(output)})", python, fix)
        return answer

    def _run(
        self,
        command: Sequence[str | Path],
        *,
        environment: Mapping[str, str] | None = None,
        cwd: Path | None = None,
        read_line: Callable[[str], object] = lambda line: None,
        limit_s: float | None = None,
    ) -> tuple[str, int]:
        """Run a program and return its output and its exit code. When this stops, the program ends with its children.

        The program holds the lock too. If this process is killed, no other set-up begins before the program has ended.
        Raises PlgsError when it cannot be started or does not end within ``limit_s`` seconds; Cancelled.
        """
        assert self._lock is not None
        return programs.run(
            command, self.log_path, environment or clean_environment(cwd), self._pause,
            cwd=cwd or self.folder, read_line=read_line, keep_open=[self._lock.descriptor], limit_s=limit_s,
        )  # fmt: skip

    def _log(self, text: str) -> None:
        with self.log_path.open("a", encoding="utf-8") as log:
            log.write(f"{text}\n")

    def _tell(self, step: int, detail: str = "") -> None:
        """Begin a step, or report more about it."""
        label = f"{LABELS[step - 1]}: {detail}" if detail else LABELS[step - 1]
        if (step, label) != (self._step, self._label):
            self._step, self._label = step, label
            self._events.stage(STAGE, step, len(LABELS), label)
            self._tell_progress()

    def _pause(self) -> None:
        """Wait a moment. Raises Cancelled when this is asked to stop."""
        self._stop.check()
        time.sleep(_POLL_S)
        if time.monotonic() - self._measured_at > _MEASURE_S:
            self._measured_at = time.monotonic()
            if self._environment is not None:
                installed = bytes_in(self._environment) / _INSTALLED_BYTES[self.request.torch_build]
                self._done = max(self._done, _INSTALLED * min(1.0, installed))
            self._tell_progress()

    def _tell_progress(self) -> None:
        self._events.progress(STAGE, round(PARTS * self._done), PARTS)
