"""The steps of a set-up, from uv to an engine that answers. Downloads of uv are kept until the environment is complete:
a set-up after one that was cancelled, killed or cut off uses them."""

from __future__ import annotations

import os
import re
import shutil
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import PlgsError
from ..job import EventWriter, StopSignal, write_atomically
from ..job.atomic import sha256
from ..job.environment import (
    COMPLETE,
    Version,
    environment_name,
    environments_folder,
    is_complete,
    needed_packages,
    pinned_hashes,
    pinned_versions,
    python_in,
    requirement_file,
)
from ..job.handshake import ADDED, EngineAnswer
from ..job.lock import FileLock, is_locked
from ..job.own_files import OwnFiles
from ..job.process import ROOT, engine_call
from . import uv_program
from .environments import DOWNLOADS, LOCK, LOG, PYTHON, empty_trash, refuse_others, throw_away
from .programs import UvTask, complaint

LABELS = (
    "Downloading uv",
    "Making the environment",
    "Installing torch",
    "Installing the other packages",
    "Compiling for this computer",
    "Asking the engine",
)
DOWNLOAD_LABELS = (LABELS[0], "Finding a Python", "Downloading wheels")
_AGAIN = "set up the engine again: it continues where it stopped."
_ANSWER_S = 10.0
"""Seconds within which a Python must answer. The first answer from a cold disk takes a few."""
NEEDED_BYTES = {"cpu": 5e9, "cuda": 15e9}
"""Free bytes on the disk for the environment and for what is unpacked meanwhile, rounded up."""
_BY_HASH = ("--no-deps", "--require-hashes", "--requirement")
_TORCH_FOR_CPU = "https://download.pytorch.org/whl/cpu"
_LISTED = re.compile(r"(\S+)==([^\s+]+)(?:\+\S+)? --hash=sha256:([0-9a-f]{64})")
_FOREIGN_FIX = (
    "If it is the wheel that 'set-up --download' named on a computer that you trust, give its hash with --torch-hash. "
    "Otherwise collect the wheels again."
)
_SYNC = "import os; getattr(os, 'sync', lambda: None)()"  # Windows has no os.sync


@dataclass(frozen=True)
class SetUpRequest:
    """The options of a set-up. ``base_python`` None means the running Python, or another with pinned packages.
    ``torch_build`` is "cpu" or "cuda". With ``index_url`` "" packages come from where uv or pip is configured to look;
    ``wheels`` is a folder from which they come instead, without a network. ``download`` is such a folder to make,
    instead of an environment. ``torch_hash`` is the SHA-256 of torch's wheel, for a build whose hash is not pinned."""

    base_python: Path | None = None
    torch_build: str = "cpu"
    index_url: str = ""
    wheels: Path | None = None
    download: Path | None = None
    torch_hash: str = ""

    def torch_list(self, version: Version) -> str:
        """Return the name of the file in a folder of wheels that lists torch's, with their hashes."""
        return f"torch-{self.torch_build}-{version[0]}.{version[1]}.txt"


class SetUp(UvTask):
    """One set-up. `run` does all of it."""

    def __init__(
        self,
        request: SetUpRequest,
        events: EventWriter,
        stop: StopSignal,
        root: Path = ROOT,
        folder: Path | None = None,
    ) -> None:
        """Prepare a set-up. ``folder`` is for environments, log and lock (None: in the user's cache), ``root`` has
        engine/ and requirements/."""
        self.request, self.root = request, root
        self.folder = folder or environments_folder()
        super().__init__(
            "set-up", LABELS if request.download is None else DOWNLOAD_LABELS, _AGAIN, events, stop,
            log_path=self.folder / LOG, cwd=self.folder,
        )  # fmt: skip
        self._use_packages(request.index_url, request.wheels, self.folder / DOWNLOADS)
        self._variables["UV_PYTHON_INSTALL_DIR"] = str(self.folder / PYTHON)

    def run(self) -> Path:
        """Do all steps; return the environment's Python, or the wheels' folder. Raises PlgsError if a step fails;
        Cancelled."""
        try:
            refuse_others(self.folder)
            self.folder.mkdir(parents=True, exist_ok=True)
            while is_locked(self.folder / LOCK):
                self._tell(1, "Another set-up is running")
                self._pause()
            with FileLock(self.folder / LOCK) as self._lock:
                self.log_path.write_bytes(b"")
                return self._do_steps()
        except OSError as error:
            fix = f"Make room on the disk, or let PLGS write there, then {_AGAIN}"
            where = error.filename or self.folder
            raise PlgsError("set-up-stopped", f"the set-up was stopped ({error.strerror})", where, fix) from error

    def _do_steps(self) -> Path:
        given = self.request.base_python
        if given is not None and not os.access(given, os.X_OK):
            self.log_path.write_text(f"{given} cannot be run\n", encoding="utf-8")
            fix = "Name another Python in the preferences."
            raise PlgsError("no-python", f"{given} cannot be run", self.log_path, fix)
        self._tell(1)
        uv = self._get_uv(self.folder)
        python, version = self._find_python(uv)
        if self.request.download is not None:
            self._collect_wheels(uv, python, version, self.request.download.absolute())
            throw_away(self.folder / DOWNLOADS, self.folder)
            empty_trash(self.folder)
            return self.request.download
        environment = self.folder / environment_name(self.root, version)
        if not self._is_ready(environment):
            self._refuse_full_disk(self.folder, NEEDED_BYTES[self.request.torch_build])
            self._make_environment(uv, environment, python, version)
            self._install_packages(uv, environment, version)
            self._compile_kernels(environment)
            self._finish(environment)
        throw_away(self.folder / DOWNLOADS, self.folder)
        empty_trash(self.folder)
        return python_in(environment)

    def _find_python(self, uv: Path) -> tuple[str | Path, Version]:
        """Return a Python for `uv venv`: the given one, else the running one, one of this computer, or one to get."""
        versions = pinned_versions(self.root)
        if not versions:
            what = "the requirements are missing"
            raise PlgsError("no-requirements", what, self.root / "requirements", "Install PLGS again.")
        given = self.request.base_python
        names = [f"{major}.{minor}" for major, minor in versions]
        for python in [given] if given is not None else [sys.executable, *names]:
            self._tell(2, str(python))
            find = ["python", "find", "--no-project", "--no-python-downloads", "--show-version"]
            output, code = self._run([uv, *find, python], self._variables, limit_s=_ANSWER_S)
            version = re.match(r"(\d+)\.(\d+)", output)
            if code == 0 and version is not None and (int(version[1]), int(version[2])) in versions:
                return python, (int(version[1]), int(version[2]))
        if given is None:
            return names[0], versions[0]  # uv downloads it
        why = complaint(output) if version is None else f"it is Python {output.strip()}"
        fix = f"Name a Python {' or '.join(names)} in the preferences, or none: then PLGS finds or downloads one."
        what = f"{given} cannot make the engine's environment ({why})"
        raise PlgsError("no-python", what, self.log_path, fix)

    def _is_ready(self, environment: Path) -> bool:
        """Whether nothing is left to do. An environment that does not answer, or has another torch, is deleted."""
        if not is_complete(environment):
            return False
        if (environment / COMPLETE).read_text(encoding="utf-8").endswith(f" {self.request.torch_build}\n"):
            with suppress(PlgsError):
                if not self._ask(python_in(environment)).missing:
                    return True
        throw_away(environment, self.folder)
        return False

    def _make_environment(self, uv: Path, environment: Path, python: str | Path, version: Version) -> None:
        """Make the environment from scratch. It is quick, as downloads are kept elsewhere."""
        self._tell(2, f"Python {version[0]}.{version[1]}")
        throw_away(environment, self.folder)
        output, code = self._run([uv, "venv", "--no-project", "--python", python, environment], self._variables)
        if code != 0:
            what = f"{python} could not create an environment ({complaint(output)})"
            raise PlgsError("environment-failed", what, self.log_path, "Name another Python in the preferences.")

    def _install_packages(self, uv: Path, environment: Path, version: Version) -> None:
        """Install torch, which is checked against a pinned hash only if it comes from a folder of wheels, then
        everything else, always checked."""
        install: list[str | Path] = [uv, "pip", "install", "--no-build", "--python", python_in(environment)]
        self._tell(3)
        if self.request.wheels is not None:
            listed = self.request.wheels.absolute() / self.request.torch_list(version)
            if not listed.is_file():
                fix = "Give 'set-up --download' the same --torch and a --base-python of the same version."
                raise PlgsError("no-wheels", f"there is no {listed.name} among the wheels", listed.parent, fix)
            self._install("torch", [*install, *_BY_HASH, self._pinned_list(listed, version)])
        else:
            self._install("torch", [*install, *self._torch_options(version, "--torch-backend", "cpu")])
        self._tell(4)
        self._install("packages", [*install, *_BY_HASH, requirement_file(self.root, "hashes", version)])

    def _pinned_list(self, listed: Path, version: Version) -> Path:
        """Return a copy of the list of torch's wheels, after checking that our own lists have every name, version and
        hash in it. Raises PlgsError otherwise: who can write to the folder could exchange a wheel and its line."""
        pinned = {
            *pinned_hashes(requirement_file(self.root, "hashes-torch")),
            *pinned_hashes(requirement_file(self.root, "hashes", version)),
            *(
                ("torch", needed_packages(self.root, version)["torch"], each)
                for each in [self.request.torch_hash]
                if each
            ),
        }
        text = listed.read_text(encoding="utf-8", errors="replace")
        for line in text.splitlines():
            match = _LISTED.fullmatch(line)
            found = match and (match[1].lower().replace("_", "-"), match[2], match[3])
            if found not in pinned:
                what = f"PLGS does not know the wheel {line!r}"
                raise PlgsError("foreign-wheel", what, listed, _FOREIGN_FIX, option="--torch-hash")
        copy = self.folder / DOWNLOADS / listed.name
        copy.parent.mkdir(exist_ok=True)
        write_atomically(copy, text)
        return copy

    def _torch_options(self, version: Version, *of_public_cpu_builds: str) -> list[str]:
        torch = f"torch=={needed_packages(self.root, version)['torch']}"
        if self.request.torch_build == "cuda":  # with what torch needs of CUDA
            return ["--constraint", str(requirement_file(self.root, "constraints", version)), torch]
        # Where the user has an index or a folder of his own, torch's CPU build has to be there.
        is_public = not self.request.index_url and "UV_FIND_LINKS" not in self._variables
        return ["--no-deps", *(of_public_cpu_builds if sys.platform == "linux" and is_public else ()), torch]

    def _collect_wheels(self, uv: Path, python: str | Path, version: Version, folder: Path) -> None:
        """Download everything that a set-up and all additions install for this system and Python, and uv. Raises
        PlgsError for a folder that holds anything else."""
        self._tell(3)
        own = OwnFiles(folder).begin("wheels", {}, replaces=True)
        own.announce()
        pip, part = self.folder / DOWNLOADS / "pip", folder / "torch.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        command: list[str | Path] = [uv, "pip", "install", "--python", python, "--target", pip, *_BY_HASH]
        self._install("pip", [*command, self.root / "requirements/pip.txt"])
        name, digest = uv_program.pinned_wheel()
        (pip / "uv.txt").write_text(f"uv=={uv_program.VERSION} --hash=sha256:{digest}\n")  # for --require-hashes
        collect: list[str | Path] = [uv, "run", "--no-project", "--python", python, "--", "python", "-I", pip / "pip"]
        collect += ["download", "--only-binary", ":all:", "--dest"]
        options = self._torch_options(version, "--index-url", _TORCH_FOR_CPU)
        self._install("torch", [*collect, part, *options], for_pip=True)
        lines = []
        for wheel in sorted(part.iterdir()):
            name, number, _ = wheel.name.split("-", 2)
            lines.append(f"{name}=={number} --hash=sha256:{sha256(wheel)}\n")
            wheel.replace(folder / wheel.name)
        part.rmdir()
        collect += [folder, *_BY_HASH]
        packages = requirement_file(self.root, "hashes", version)
        self._install("packages", [*collect, packages, "--requirement", pip / "uv.txt"], for_pip=True)
        for name in ADDED:
            try:
                self._install(name, [*collect, requirement_file(self.root, f"hashes-{name}")], for_pip=True)
            except PlgsError as error:
                self._events.warning(f"The folder will lack {name}: {error.what}")
        with own:
            write_atomically(folder / self.request.torch_list(version), "".join(lines))
        own.complete()
        try:
            self._pinned_list(folder / self.request.torch_list(version), version)
        except PlgsError as error:
            self._events.warning(f"{error.what}: set-up --wheels needs its hash with --torch-hash")

    def _compile_kernels(self, environment: Path) -> None:
        """Compile the kernels of a lift. This is also the best test that the engine works here."""
        self._tell(5, "half a minute")
        output, code = self._run([*engine_call(python_in(environment), self.root), "warm-up"], cwd=self.root)
        if code != 0:
            what = f"the engine does not work in its new environment ({complaint(output)})"
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
        """Return the answer of the engine in ``python``. Raises PlgsError if there is none."""
        self._tell(6)
        output, code = self._run([*engine_call(python, self.root), "handshake"], cwd=self.root, limit_s=_ANSWER_S)
        answer = EngineAnswer.from_line(output.splitlines()[-1]) if code == 0 and output else None
        if answer is None:
            fix = "Remove the engine, then set it up again."
            raise PlgsError("silent", f"the engine does not answer ({complaint(output)})", python, fix)
        return answer
