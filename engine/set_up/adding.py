"""Add packages to an existing engine, for a capability that not everybody needs. They go into a folder of their own in
the environment, and one file in site-packages names that folder. Until the last step writes this file, the environment
is as it was."""

from __future__ import annotations

import shutil
import site
import sys
from pathlib import Path

from ..errors import PlgsError
from ..job import EventWriter, StopSignal, write_atomically
from ..job.environment import environments_folder, python_in, requirement_file
from ..job.handshake import ADDED, CAPABILITIES
from ..job.lock import FileLock
from ..job.process import ROOT, missing_modules
from .programs import UvTask

LABELS = ("Downloading and unpacking", "Checking that they are found")
_AGAIN = "add it again. The engine is unchanged."
_SPARE_BYTES = 200_000_000
"""Free bytes beside twice the packages' size: uv keeps what it has downloaded until it is written."""


class Addition(UvTask):
    """A task that adds the packages of one capability to an environment; `run` does it."""

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
        """``environment`` is by default that of the Python that runs this; any other one must have a Python of the same
        version. ``tools`` is the folder for uv; None: the user's cache. ``wheels``: as in `SetUpRequest`. Raises
        PlgsError for an unknown ``name`` and a missing folder."""
        if name not in ADDED:
            what = f'nothing called "{name}" can be added to an engine'
            raise PlgsError("not-addable", what, "add", f"Choose {', '.join(ADDED)}.")
        self.name, self.size = name, CAPABILITIES[name].size
        self.environment, self._python = environment, python_in(environment)
        self._root, self._tools = root, tools or environments_folder()
        self._site_packages = Path(site.getsitepackages([str(environment)])[0])
        self._part = environment / "added" / f"{name}.part"
        self._downloads = self._part / "downloads"
        super().__init__(
            "add", LABELS, _AGAIN, events, stop,
            log_path=environment / "add.log", cwd=self._part,
        )  # fmt: skip
        self._use_packages(index_url, wheels, self._downloads)

    def run(self) -> Path:
        """Install the packages and return their folder. Raises PlgsError if that fails; Cancelled."""
        if not (self.environment / "pyvenv.cfg").is_file():  # other Pythons belong to the system or to Blender
            fix = "Set up the engine, or install the packages that requirements/ pins into your own Python."
            what = "packages can be added only to a virtual environment"
            raise PlgsError("not-environment", what, self.environment, fix)
        folder = self._part.with_suffix("")
        try:
            with FileLock(self.environment / "add.lock") as self._lock:
                self._refuse_full_disk(self.environment, 2 * self.size + _SPARE_BYTES)
                try:
                    self._download()
                    shutil.rmtree(folder, ignore_errors=True)
                    self._part.rename(folder)
                finally:
                    shutil.rmtree(self._part, ignore_errors=True)
                write_atomically(self._site_packages / f"plgs-{self.name}.pth", f"{folder}\n")
            self._look()
        except OSError as error:
            fix = f"Make room on the disk, or let PLGS write there, then {_AGAIN}"
            where = error.filename or self.environment
            raise PlgsError("nothing-added", f"packages could not be added ({error.strerror})", where, fix) from error
        return folder

    def _download(self) -> None:
        self._tell(1)
        shutil.rmtree(self._part, ignore_errors=True)
        packages = self._part / "packages"  # not `_part` itself, which also holds uv's downloads
        packages.mkdir(parents=True)
        self.log_path.write_bytes(b"")
        pins = requirement_file(self._root, self.name)  # also for whatever compiles a package that has no wheel here
        self._install(self.name, [
            self._get_uv(self._tools), "pip", "install", "--python", self._python, "--target", packages, "--no-deps",
            "--require-hashes", "--requirement", requirement_file(self._root, f"hashes-{self.name}"),
            "--build-constraints", pins,
        ])  # fmt: skip
        shutil.rmtree(self._downloads, ignore_errors=True)
        for path in packages.iterdir():
            path.rename(self._part / path.name)
        packages.rmdir()

    def _look(self) -> None:
        self._tell(2)
        modules = list(CAPABILITIES[self.name].packages.values())
        missing = missing_modules(self._python, modules)
        if missing:
            what = f"the added packages are not found ({', '.join(missing)})"
            fix = "Remove the engine, then set it up and add them again."
            raise PlgsError("packages-lost", what, self._site_packages, fix)
