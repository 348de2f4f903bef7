"""Make the engine's environment: a state machine over other programs that is polled and never waits for them.

The steps are one generator, read from top to bottom; each ``yield`` is a poll. What a step finished is noted in the
environment, so a set-up that was cancelled, killed or cut off goes on there. Knows nothing of Blender.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from ...engine.job import JobError, write_atomically
from ...engine.job.environment import COMPLETE, environment_name, environments_folder, is_complete, python_in
from ...engine.job.handshake import EngineAnswer
from ...engine.job.lock import FileLock, is_locked
from ...engine.job.process import ROOT, clean_environment, engine_call
from ...engine.job.requirements import constraints_path, hashes_path, needed_packages, pinned_versions
from . import pip
from .base_python import PROBE, BasePython, candidates, judge, wanted
from .disk_meter import DiskMeter
from .handshake import Handshake, NoAnswer
from .notes import Notes
from .program import run_program
from .progress import Outcome, Progress, Share, Wish
from .trash import delete_command, throw_away, thrown_away

LOG, LOCK = "set-up.log", "set-up.lock"
_PROBE_S = 10.0
_GIGABYTE = 10**9
NEEDED_BYTES = {"cpu": 4 * _GIGABYTE, "cuda": 14 * _GIGABYTE}
"""Free disk for the environment, for what is unpacked meanwhile and for pip's own cache, rounded up."""
# What the two calls of pip leave on the disk, while they run a little more.
_TORCH_BYTES = {"cpu": 0.75 * _GIGABYTE, "cuda": 1.5 * _GIGABYTE}
_OTHER_BYTES = {"cpu": 0.55 * _GIGABYTE, "cuda": 5.0 * _GIGABYTE}
_COMPILING_S = 40.0
_SYNC = "import os; getattr(os, 'sync', lambda: None)()"


class SetUp:
    """One set-up. Poll it several times a second until there is an ``outcome``."""

    def __init__(
        self,
        wish: Wish,
        root: Path = ROOT,
        folder: Path | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``folder`` holds environments, log and lock; the user's cache when not given."""
        self.wish, self.root = wish, root
        self.folder = folder or environments_folder()
        self.progress = Progress()
        self.outcome: Outcome | None = None
        self._clock, self._began = clock, clock()
        self._share = Share(0.0, 0.02)
        self._lock: FileLock | None = None
        self._meter: DiskMeter | None = None
        self._work = self._all()

    @property
    def log_path(self) -> Path:
        """What all programs said."""
        return self.folder / LOG

    def poll(self) -> None:
        """Go on a little. Takes milliseconds."""
        if self.outcome is not None:
            return
        try:
            next(self._work)
        except StopIteration as end:
            self.outcome = Outcome(python=end.value)
        except JobError as error:
            self.outcome = Outcome(error=error)
        except OSError as error:
            fix = "Make room on the disk, or let PLGS write there, then set the engine up again."
            where = error.filename or self.folder
            self.outcome = Outcome(error=JobError(f"the set-up stopped ({error.strerror})", where, fix))
        self._measure()

    def cancel(self) -> None:
        """End it at once, with all programs that it started. What is there is kept for the next time."""
        if self.outcome is None:
            self._work.close()
            self.outcome = Outcome()

    def _all(self) -> Generator[None, None, Path]:
        """All steps; returns the environment's Python. Raises JobError, OSError."""
        self.folder.mkdir(parents=True, exist_ok=True)
        while is_locked(self.folder / LOCK):
            self._tell(1, "Waiting", "Another set-up is at work")
            yield
        with FileLock(self.folder / LOCK) as self._lock:
            self.log_path.write_bytes(b"")
            base = yield from self._find_base_python()
            environment = self.folder / environment_name(self.root, base.version)
            if not (yield from self._is_ready(environment)):
                self._check_disk()
                notes = yield from self._make_environment(environment, base)
                yield from self._install_packages(environment, base, notes)
                yield from self._compile_kernels(environment)
                yield from self._finish(environment)
            yield from self._empty_trash(base)
        return python_in(environment)

    def _find_base_python(self) -> Generator[None, None, BasePython]:
        versions = pinned_versions(self.root)
        if not versions:
            raise JobError("there are no requirements", self.root / "requirements", "Install PLGS again.")
        refused = []
        for python in candidates(self.wish.base_python, versions):
            self._tell(1, "Looking for a Python", str(python))
            try:
                output, code = yield from self._run([python, "-I", "-c", PROBE], limit_s=_PROBE_S)
                verdict = judge(output, code, versions)
            except JobError as error:
                verdict = error.what
            if isinstance(verdict, BasePython):
                return verdict
            refused.append(f"{python} {verdict}")
        self._log("\n".join(refused))
        fix = f"Install Python {wanted(versions)} with venv and pip, or name one in the preferences."
        raise JobError(f"no Python can make the engine's environment ({'; '.join(refused[:3])})", self.log_path, fix)

    def _is_ready(self, environment: Path) -> Generator[None, None, bool]:
        """Whether nothing is left to do. A complete environment that does not answer, or was made with another torch,
        is thrown away.
        """
        if not is_complete(environment):
            return False
        notes = Notes.read(environment)
        if notes is not None and notes.torch_build == self.wish.torch_build:
            answer = yield from self._ask(python_in(environment))
            if isinstance(answer, EngineAnswer) and not answer.missing:
                return True
        throw_away(environment, self.folder)
        return False

    def _check_disk(self) -> None:
        needed, free = NEEDED_BYTES[self.wish.torch_build], shutil.disk_usage(self.folder).free
        if free < needed:
            what = f"the disk has {free / _GIGABYTE:.1f} GB free, the engine needs {needed / _GIGABYTE:.0f} GB"
            raise JobError(what, self.folder, "Make room, then set the engine up again.")

    def _make_environment(self, environment: Path, base: BasePython) -> Generator[None, None, Notes]:
        self._tell(2, "Making the environment", f"Python {base.version[0]}.{base.version[1]}")
        self._meter = DiskMeter(environment)
        notes = Notes.read(environment)
        is_sound = notes is not None and not notes.installing and python_in(environment).exists()
        if notes is not None and is_sound and notes.torch_build == self.wish.torch_build:
            self._log(f"Going on with {environment}, which has: {', '.join(notes.done)}")
            return notes
        throw_away(environment, self.folder)
        output, code = yield from self._run([base.python, "-I", "-m", "venv", environment])
        if code != 0:
            what = f"{base.python} could not make an environment ({pip.complaint(output)})"
            raise JobError(what, self.log_path, "Name another Python in the preferences.")
        notes = Notes(self.wish.torch_build)
        notes.write(environment)
        return notes

    def _install_packages(self, environment: Path, base: BasePython, notes: Notes) -> Generator[None, None, None]:
        """First torch alone; then what has hashes; then all, which finds these there, and brings what torch needs of
        CUDA.
        """
        needed = needed_packages(self.root, base.version)
        pins = {name: f"{name}=={pin}" if pin else name for name, pin in needed.items()}
        constraints, python = constraints_path(self.root, base.version), python_in(environment)
        wish = self.wish
        self._tell(3, "Installing torch")
        self._begin(0.05, 0.5, expected_bytes=_TORCH_BYTES[wish.torch_build])
        options = pip.torch_options(wish.index_url, wish.torch_build)
        command = pip.install_command(python, [pins["torch"]], constraints, options)
        yield from self._install("torch", environment, command, notes)
        self._tell(4, "Installing the other packages")
        self._begin(0.5, 0.8, expected_bytes=_OTHER_BYTES[wish.torch_build])
        hashes = hashes_path(self.root, base.version)
        if hashes.exists():
            yield from self._install("packages", environment, pip.install_hashed_command(python, hashes), notes)
        command = pip.install_command(python, list(pins.values()), constraints, [])
        yield from self._install("what is left", environment, command, notes)

    def _install(
        self, step: str, environment: Path, command: Sequence[str | Path], notes: Notes
    ) -> Generator[None, None, None]:
        if step in notes.done:
            return
        temporary = environment / "tmp"
        throw_away(temporary, self.folder)
        temporary.mkdir()

        def read_line(line: str) -> None:
            if line.startswith(pip.INSTALLING):
                notes.installing = True
                notes.write(environment)
            if news := pip.news(line):
                self._tell(self.progress.step, self.progress.label, news)

        variables = pip.environment(temporary, self.wish.index_url)
        output, code = yield from self._run(command, environment=variables, read_line=read_line)
        if code != 0:
            fix = "See to the connection or the disk, then set the engine up again: it goes on there."
            raise JobError(f"pip could not install {step} ({pip.complaint(output)})", self.log_path, fix)
        throw_away(temporary, self.folder)
        notes.done.append(step)
        notes.installing = False
        notes.write(environment)

    def _compile_kernels(self, environment: Path) -> Generator[None, None, None]:
        """The truest test that the engine works here: a lift so small that it is of no use."""
        self._begin(0.8, 0.98, expected_s=_COMPILING_S)
        self._tell(5, "Compiling for this machine", "Half a minute")
        output, code = yield from self._run([*engine_call(python_in(environment), self.root), "warm-up"], cwd=self.root)
        if code != 0:
            what = f"the engine does not work in its new environment ({pip.complaint(output)})"
            raise JobError(what, self.log_path, "Remove the engine, then set it up again. The log tells more.")

    def _finish(self, environment: Path) -> Generator[None, None, None]:
        answer = yield from self._ask(python_in(environment))
        if isinstance(answer, NoAnswer):
            raise JobError(f"the engine does not answer: {answer.message}", environment, answer.fix)
        if answer.missing:
            fix = "Remove the engine, then set it up again."
            raise JobError(f"the new environment lacks {', '.join(answer.missing)}", environment, fix)
        # What pip wrote first: after a power cut nothing may be complete that is not there. A program, for it waits.
        yield from self._run([python_in(environment), "-I", "-c", _SYNC])
        write_atomically(environment / COMPLETE, f"{answer.python}\n")

    def _ask(self, python: Path) -> Generator[None, None, EngineAnswer | NoAnswer]:
        self._begin(0.98, 1.0)
        self._tell(6, "Asking the engine")
        with closing(Handshake(python, self.root)) as handshake:
            while (answer := handshake.poll()) is None:
                yield
        return answer

    def _empty_trash(self, base: BasePython) -> Generator[None, None, None]:
        if trash := thrown_away(self.folder):
            self._tell(6, "Deleting what is left over")
            yield from self._run(delete_command(trash, base.python))

    def _run(
        self,
        command: Sequence[str | Path],
        *,
        environment: Mapping[str, str] | None = None,
        cwd: Path | None = None,
        read_line: Callable[[str], object] = lambda line: None,
        limit_s: float | None = None,
    ) -> Generator[None, None, tuple[str, int]]:
        """A program, the log, and the lock, which it holds too: should Blender be killed, nobody else begins before the
        program has ended.
        """
        assert self._lock is not None
        environment = environment or clean_environment(cwd)
        keep = [self._lock.descriptor]
        return (
            yield from run_program(
                command, self.log_path, environment,
                cwd=cwd or self.folder, read_line=read_line, keep_open=keep, limit_s=limit_s,
            )
        )  # fmt: skip

    def _log(self, text: str) -> None:
        with self.log_path.open("a", encoding="utf-8") as log:
            log.write(f"{text}\n")

    def _tell(self, step: int, label: str, detail: str = "") -> None:
        self.progress = replace(self.progress, step=step, label=label, detail=detail)

    def _begin(self, start: float, end: float, *, expected_bytes: float = 0.0, expected_s: float = 0.0) -> None:
        now = self._meter.bytes if self._meter else 0
        self._share = Share(start, end, now, expected_bytes, self._clock(), expected_s)

    def _measure(self) -> None:
        if self._meter is not None:
            self._meter.look()
        now = self._clock()
        found = self._meter.bytes if self._meter else 0
        fraction = max(self.progress.fraction, self._share.fraction(found, now))
        self.progress = replace(self.progress, bytes_on_disk=found, elapsed_s=now - self._began, fraction=fraction)
