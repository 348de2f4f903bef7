"""Adding packages to an existing engine, for a capability that not everybody needs.

They go into a folder of their own in the environment, and one file in site-packages names that folder. Until this file
is there, which is the last step, the environment is as it was.
"""

from __future__ import annotations

import shutil
import site
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from ..errors import PlgsError
from ..job import EventWriter, StopSignal, write_atomically
from ..job.environment import environments_folder, python_in
from ..job.handshake import CAPABILITIES, addition_hashes_path, refuse_unknown, requirements_path
from ..job.lock import FileLock
from ..job.process import ROOT, missing_modules
from . import programs, uv_program
from .environments import bytes_in

STAGE = "add"
LABELS = ("Downloading and unpacking", "Checking that they are found")
_LOG, _LOCK = "add.log", "add.lock"
_FOLDER = "added"
_PARTS = 1000
_POLL_S, _MEASURE_S = 0.05, 1.0
_SPARE_BYTES = 200_000_000
"""Free bytes beside twice the packages' size: uv keeps what it has downloaded until it is written."""


class Addition:
    """The packages of one capability for an environment. `run` adds them."""

    def __init__(
        self,
        name: str,
        events: EventWriter,
        stop: StopSignal,
        *,
        root: Path = ROOT,
        environment: Path = Path(sys.prefix),
        index_url: str = "",
        wheels: Path | None = None,
        tools: Path | None = None,
    ) -> None:
        """``environment``: by default that of the Python that runs this; another environment's has the same version.
        ``tools`` is the folder for uv; None: the user's cache. ``wheels``: as in `SetUpRequest`. Raises PlgsError for
        an unknown name.
        """
        refuse_unknown(name)
        self.name, self.size = name, CAPABILITIES[name].size
        self.environment, self._python = environment, python_in(environment)
        self._events, self._stop, self._root = events, stop, root
        self._variables = programs.variables(index_url, wheels)
        self._site_packages = Path(site.getsitepackages([str(environment)])[0])
        self._tools = tools or environments_folder()
        self._part = environment / _FOLDER / f"{name}.part"
        self._measured_at = 0.0

    @property
    def log_path(self) -> Path:
        """uv's output."""
        return self.environment / _LOG

    def run(self) -> Path:
        """The folder with the packages. Raises PlgsError; Cancelled when it was asked to stop."""
        self._refuse_foreign()
        folder = self._part.with_suffix("")
        try:
            with FileLock(self.environment / _LOCK) as lock:
                self._refuse_full_disk()
                try:
                    self._download(lock)
                    shutil.rmtree(folder, ignore_errors=True)
                    self._part.rename(folder)
                finally:
                    shutil.rmtree(self._part, ignore_errors=True)
                write_atomically(self._site_packages / f"plgs-{self.name}.pth", f"{folder}\n")
            self._look()
        except OSError as error:
            fix = "Make room on the disk, or let PLGS write there, then add it again. The engine is unchanged."
            where = error.filename or self.environment
            raise PlgsError("nothing-added", f"packages could not be added ({error.strerror})", where, fix) from error
        return folder

    def _refuse_foreign(self) -> None:
        """Only an environment gets packages: other Pythons belong to the system or to Blender."""
        if not (self.environment / "pyvenv.cfg").is_file():
            fix = "Set up the engine, or let your own Python install the packages that requirements/ pins."
            what = "packages can be added only to a virtual environment"
            raise PlgsError("not-environment", what, self.environment, fix)

    def _refuse_full_disk(self) -> None:
        needed, free = 2 * self.size + _SPARE_BYTES, shutil.disk_usage(self.environment).free
        if free < needed:
            what = f"the disk has {free / 1e9:.1f} GB free, but adding this needs {needed / 1e9:.1f} GB"
            raise PlgsError("disk-full", what, self.environment, "Make room, then add it again.")

    def _download(self, lock: FileLock) -> None:
        self._events.stage(STAGE, 1, len(LABELS), LABELS[0])
        shutil.rmtree(self._part, ignore_errors=True)
        packages, downloads = self._part / "packages", self._part / "downloads"
        packages.mkdir(parents=True)
        variables = self._variables | {"UV_CACHE_DIR": str(downloads)}
        programs.refuse_diverted(self._part)
        self.log_path.write_bytes(b"")
        uv = uv_program.program_in(self._tools)
        if not uv.exists():
            output, code = self._run([sys.executable, "-I", Path(uv_program.__file__), self._tools], variables, lock)
            if code != 0:
                fix = "Check the connection and the package index, then add it again. The engine is unchanged."
                raise PlgsError("uv-download", programs.complaint(output), "the package index", fix)
        pins = requirements_path(self._root, self.name)  # also for whatever compiles a package that has no wheel here
        hashes = addition_hashes_path(self._root, self.name)
        command: list[str | Path] = [
            uv, "pip", "install", "--python", self._python, "--target", packages,
            "--no-deps", "--require-hashes", "--requirement", hashes, "--build-constraints", pins,
        ]  # fmt: skip
        output, code = self._run(command, variables, lock)
        if code != 0:
            fix = "Check the connection and the disk, then add it again. The engine is unchanged."
            raise PlgsError("uv-failed", f"uv could not add it ({programs.complaint(output)})", self.log_path, fix)
        shutil.rmtree(downloads, ignore_errors=True)
        for path in packages.iterdir():
            path.rename(self._part / path.name)
        packages.rmdir()

    def _run(self, command: Sequence[str | Path], variables: dict[str, str], lock: FileLock) -> tuple[str, int]:
        return programs.run(
            command, self.log_path, variables, self._pause, cwd=self._part,
            read_line=self._tell, keep_open=[lock.descriptor], limit_s=None,
        )  # fmt: skip

    def _look(self) -> None:
        self._events.stage(STAGE, 2, len(LABELS), LABELS[1])
        modules = list(CAPABILITIES[self.name].packages.values())
        missing = missing_modules(self._python, modules)
        if missing:
            what = f"the added packages are not found ({', '.join(missing)})"
            fix = "Remove the engine, then set it up and add them again."
            raise PlgsError("packages-lost", what, self._site_packages, fix)

    def _tell(self, line: str) -> None:
        if news := programs.news_of_uv(line):
            self._events.stage(STAGE, 1, len(LABELS), f"{LABELS[0]}: {news}")

    def _pause(self) -> None:
        """Wait a moment. Raises Cancelled when this is asked to stop."""
        self._stop.check()
        time.sleep(_POLL_S)
        if time.monotonic() - self._measured_at > _MEASURE_S:
            self._measured_at = time.monotonic()
            done = min(1.0, bytes_in(self._part / "downloads") / self.size)
            self._events.progress(STAGE, round(_PARTS * done), _PARTS)
