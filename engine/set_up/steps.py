"""The steps of a set-up, from uv to an engine that answers.

What uv has downloaded stays until the environment is complete. A set-up that was cancelled, killed or cut off makes the
environment anew from it.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import PlgsError
from ..job import EventWriter, StopSignal, write_atomically
from ..job.atomic import sha256
from ..job.environment import (
    COMPLETE,
    Version,
    constraints_path,
    environment_name,
    environments_folder,
    hashes_path,
    is_complete,
    needed_packages,
    pinned_versions,
    python_in,
)
from ..job.handshake import ADDED, EngineAnswer, addition_hashes_path
from ..job.lock import FileLock, is_locked
from ..job.process import ROOT, clean_environment, engine_call
from . import programs, uv_program
from .environments import DOWNLOADS, LOCK, LOG, PYTHON, bytes_in, empty_trash, throw_away

STAGE = "set-up"
LABELS = (
    "Downloading uv",
    "Making the environment",
    "Installing torch",
    "Installing the other packages",
    "Compiling for this computer",
    "Asking the engine",
)
DOWNLOAD_LABELS = (LABELS[0], "Finding a Python", "Downloading wheels")
PARTS = 1000
"""The progress of the whole set-up is counted in this many parts."""
_ANSWER_S = 10.0
"""Seconds within which a Python must answer. The first answer from a cold disk takes a few."""
_POLL_S = 0.05
_MEASURE_S = 1.0
_GIGABYTE = 10**9
NEEDED_BYTES = {"cpu": 5 * _GIGABYTE, "cuda": 15 * _GIGABYTE}
"""Free bytes on the disk for the environment and for what is unpacked meanwhile, rounded up."""
_INSTALLED_BYTES = {"cpu": 1.8 * _GIGABYTE, "cuda": 7.0 * _GIGABYTE}
"""Bytes that the installed packages take on the disk."""
_INSTALLED, _COMPILED = 0.8, 0.98
"""Parts of the whole that are done when the packages are installed, and when the kernels are compiled."""
_BY_HASH = ("--no-deps", "--require-hashes", "--requirement")
_TORCH_FOR_CPU = "https://download.pytorch.org/whl/cpu"
_SYNC = "import os; getattr(os, 'sync', lambda: None)()"


@dataclass(frozen=True)
class SetUpRequest:
    """``base_python`` None takes this one, or another that the packages are pinned for. ``torch_build`` is "cpu" or
    "cuda". An empty ``index_url`` lets packages come from where uv or pip is configured to look; ``wheels`` is a folder
    that they come from instead, without a network. ``download`` is such a folder to make, instead of an environment.
    """

    base_python: Path | None = None
    torch_build: str = "cpu"
    index_url: str = ""
    wheels: Path | None = None
    download: Path | None = None

    def torch_list(self, version: Version) -> str:
        """The name of the file in a folder of wheels that lists torch's, with their hashes."""
        return f"torch-{self.torch_build}-{version[0]}.{version[1]}.txt"


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
        self._variables = programs.variables(request.index_url, request.wheels) | {
            "UV_CACHE_DIR": str(self.folder / DOWNLOADS),
            "UV_PYTHON_INSTALL_DIR": str(self.folder / PYTHON),
        }
        self._labels = LABELS if request.download is None else DOWNLOAD_LABELS
        self._done, self._measured_at = 0.0, 0.0
        self._step, self._label = 0, ""
        self._lock: FileLock | None = None

    @property
    def log_path(self) -> Path:
        """The output of all programs."""
        return self.folder / LOG

    def run(self) -> Path:
        """Do all steps and return the environment's Python, or the folder of wheels. Raises PlgsError; Cancelled when
        it was asked to stop."""
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
        programs.refuse_diverted(self.folder)
        given = self.request.base_python
        if given is not None and not os.access(given, os.X_OK):
            self.log_path.write_text(f"{given} cannot be run\n", encoding="utf-8")
            fix = "Name another Python in the preferences."
            raise PlgsError("no-python", f"{given} cannot be run", self.log_path, fix)
        uv = self._get_uv()
        python, version = self._find_python(uv)
        if self.request.download is not None:
            self._collect_wheels(uv, python, version, self.request.download.absolute())
            throw_away(self.folder / DOWNLOADS, self.folder)
            empty_trash(self.folder)
            return self.request.download
        environment = self.folder / environment_name(self.root, version)
        if not self._is_ready(environment):
            self._check_disk()
            self._make_environment(uv, environment, python, version)
            self._install_packages(uv, environment, version)
            self._compile_kernels(environment)
            self._finish(environment)
        throw_away(self.folder / DOWNLOADS, self.folder)
        empty_trash(self.folder)
        return python_in(environment)

    def _get_uv(self) -> Path:
        self._tell(1)
        uv = uv_program.program_in(self.folder)
        if not uv.exists():
            command: list[str | Path] = [sys.executable, "-I", Path(uv_program.__file__), self.folder]
            output, code = self._run(command, environment=self._variables)
            if code != 0:
                fix = "Check the connection and the package index, then set up the engine again."
                raise PlgsError("uv-download", programs.complaint(output), "the package index", fix)
        return uv

    def _find_python(self, uv: Path) -> tuple[str | Path, Version]:
        """A Python for `uv venv`: the given one, else this one, else one on this computer, else one to download."""
        versions = pinned_versions(self.root)
        if not versions:
            what = "the requirements are missing"
            raise PlgsError("no-requirements", what, self.root / "requirements", "Install PLGS again.")
        given = self.request.base_python
        names = [f"{major}.{minor}" for major, minor in versions]
        for python in [given] if given is not None else [sys.executable, *names]:
            self._tell(2, str(python))
            command: list[str | Path] = [
                uv,
                "python",
                "find",
                "--no-project",
                "--no-python-downloads",
                "--show-version",
                python,
            ]
            output, code = self._run(command, environment=self._variables, limit_s=_ANSWER_S)
            version = re.match(r"(\d+)\.(\d+)", output)
            if code == 0 and version is not None and (int(version[1]), int(version[2])) in versions:
                return python, (int(version[1]), int(version[2]))
        if given is None:
            return names[0], versions[0]
        why = programs.complaint(output) if version is None else f"it is Python {output.strip()}"
        fix = f"Name a Python {' or '.join(names)} in the preferences, or none: then PLGS finds or downloads one."
        what = f"{given} cannot make the engine's environment ({why})"
        raise PlgsError("no-python", what, self.log_path, fix)

    def _is_ready(self, environment: Path) -> bool:
        """Whether nothing is left to do. A complete environment that does not answer, or was made with another torch,
        is thrown away.
        """
        if not is_complete(environment):
            return False
        if (environment / COMPLETE).read_text(encoding="utf-8").endswith(f" {self.request.torch_build}\n"):
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

    def _make_environment(self, uv: Path, environment: Path, python: str | Path, version: Version) -> None:
        """Make it from scratch. This is quick, as downloads are kept elsewhere."""
        self._tell(2, f"Python {version[0]}.{version[1]}")
        throw_away(environment, self.folder)
        output, code = self._run(
            [uv, "venv", "--no-project", "--python", python, environment], environment=self._variables
        )
        if code != 0:
            what = f"{python} could not make an environment ({programs.complaint(output)})"
            raise PlgsError("environment-failed", what, self.log_path, "Name another Python in the preferences.")

    def _install_packages(self, uv: Path, environment: Path, version: Version) -> None:
        """Install torch, of which no hashes are kept, then all else by its hashes."""
        install: list[str | Path] = [uv, "pip", "install", "--no-build", "--python", python_in(environment)]
        self._tell(3)
        if self.request.wheels is not None:
            listed = self.request.wheels.absolute() / self.request.torch_list(version)
            if not listed.is_file():
                fix = "Give 'set-up --download' the same --torch and a --base-python of the same version."
                raise PlgsError("no-wheels", f"there is no {listed.name} among the wheels", listed.parent, fix)
            self._install("torch", [*install, *_BY_HASH, listed])
        else:
            self._install("torch", [*install, *self._torch_options(version, "--torch-backend", "cpu")])
        self._tell(4)
        self._install("packages", [*install, *_BY_HASH, hashes_path(self.root, version)])

    def _torch_options(self, version: Version, *of_public_cpu_builds: str) -> list[str]:
        torch = f"torch=={needed_packages(self.root, version)['torch']}"
        if self.request.torch_build == "cuda":  # with what torch needs of CUDA
            return ["--constraint", str(constraints_path(self.root, version)), torch]
        # Where the user has an index or a folder of his own, torch's CPU build has to be there.
        is_public = not self.request.index_url and "UV_FIND_LINKS" not in self._variables
        return ["--no-deps", *(of_public_cpu_builds if sys.platform == "linux" and is_public else ()), torch]

    def _collect_wheels(self, uv: Path, python: str | Path, version: Version, folder: Path) -> None:
        """Download for this system and Python what a set-up and all additions install, and uv."""
        self._tell(3)
        pip, part = self.folder / DOWNLOADS / "pip", folder / "torch.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        command: list[str | Path] = [uv, "pip", "install", "--python", python, "--target", pip, *_BY_HASH]
        self._install("pip", [*command, self.root / "requirements/pip.txt"])
        name, digest = uv_program.pinned_wheel()
        (pip / "uv.txt").write_text(f"uv=={uv_program.VERSION} --hash=sha256:{digest}\n")
        collect: list[str | Path] = [uv, "run", "--no-project", "--python", python, "--", "python", "-I", pip / "pip"]
        collect += ["download", "--only-binary", ":all:", "--dest"]
        options = self._torch_options(version, "--index-url", _TORCH_FOR_CPU)
        self._install("torch", [*collect, part, *options], for_pip=True)
        lines = []
        for wheel in sorted(part.iterdir()):  # no hashes of torch's builds are pinned, so they are recorded here
            name, number, _ = wheel.name.split("-", 2)
            lines.append(f"{name}=={number} --hash=sha256:{sha256(wheel)}\n")
            wheel.replace(folder / wheel.name)
        part.rmdir()
        collect += [folder, *_BY_HASH]
        packages = hashes_path(self.root, version)
        self._install("packages", [*collect, packages, "--requirement", pip / "uv.txt"], for_pip=True)
        for name in ADDED:
            try:
                self._install(name, [*collect, addition_hashes_path(self.root, name)], for_pip=True)
            except PlgsError as error:
                self._events.warning(f"The folder will lack {name}: {error.what}")
        write_atomically(folder / self.request.torch_list(version), "".join(lines))

    def _install(self, what: str, command: Sequence[str | Path], *, for_pip: bool = False) -> None:
        variables = uv_program.pip_variables(self._variables) if for_pip else self._variables
        output, code = self._run(command, environment=variables)
        if code != 0:
            fix = "Check the connection and the disk, then set up the engine again: it continues there."
            why = f"uv could not install {what} ({programs.complaint(output)})"
            raise PlgsError("uv-failed", why, self.log_path, fix)

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
        write_atomically(environment / COMPLETE, f"{answer.python} {self.request.torch_build}\n")

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
        limit_s: float | None = None,
    ) -> tuple[str, int]:
        """Run a program and return its output and its exit code. When this stops, the program ends with its children.

        The program holds the lock too. If this process is killed, no other set-up begins before the program has ended.
        Raises PlgsError when it cannot be started or does not end within ``limit_s`` seconds; Cancelled.
        """
        assert self._lock is not None
        return programs.run(
            command, self.log_path, environment or clean_environment(cwd), self._pause,
            cwd=cwd or self.folder, read_line=self._tell_news, keep_open=[self._lock.descriptor], limit_s=limit_s,
        )  # fmt: skip

    def _tell_news(self, line: str) -> None:
        if news := programs.news_of_uv(line):
            self._tell(self._step, news)

    def _tell(self, step: int, detail: str = "") -> None:
        """Begin a step, or report more about it."""
        label = f"{self._labels[step - 1]}: {detail}" if detail else self._labels[step - 1]
        if (step, label) != (self._step, self._label):
            self._step, self._label = step, label
            self._events.stage(STAGE, step, len(self._labels), label)
            self._tell_progress()

    def _pause(self) -> None:
        """Wait a moment. Raises Cancelled when this is asked to stop."""
        self._stop.check()
        time.sleep(_POLL_S)
        if time.monotonic() - self._measured_at > _MEASURE_S:
            self._measured_at = time.monotonic()
            downloads = self.request.download or self.folder / DOWNLOADS
            unpacked = bytes_in(downloads) / _INSTALLED_BYTES[self.request.torch_build]
            self._done = max(self._done, _INSTALLED * min(1.0, unpacked))
            self._tell_progress()

    def _tell_progress(self) -> None:
        self._events.progress(STAGE, round(PARTS * self._done), PARTS)
