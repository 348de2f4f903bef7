"""What set-up and additions have in common: uv, a log for the output of programs, progress, and cancelling."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..errors import ErrorCode, PlgsError
from ..gates import without_credentials
from ..job import EventWriter, StopSignal
from ..job.lock import FileLock
from ..job.process import ChildProcess, clean_environment
from . import uv_program

_POLL_S = 0.05
_MOST_BYTES = 200_000  # bytes of a program's output that are kept, counted from its end


def complaint(output: str) -> str:
    """Return the first error in a program's output and what caused it, else its last line."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    first = next((index for index, line in enumerate(lines) if line.startswith("error:")), len(lines) - 1)
    said = [line.removeprefix("error:").removeprefix("cause:").strip() for line in lines[max(first, 0) :]]
    return without_credentials((": ".join(said) or "no reason given")[:300])


class UvTask:
    """Runs programs one after another in ``cwd``, with their output in a log. ``labels`` are the steps; ``again`` is
    what to do after a failure."""

    def __init__(
        self, stage: str, labels: Sequence[str], again: str, events: EventWriter, stop: StopSignal,
        *, log_path: Path, cwd: Path,
    ) -> None:  # fmt: skip
        self.log_path = log_path
        self._stage, self._labels, self._again, self._events, self._stop = stage, labels, again, events, stop
        self._cwd = cwd
        self._variables: dict[str, str] = {}
        self._step, self._label = 0, ""
        self._lock: FileLock | None = None

    def _use_packages(self, index_url: str, wheels: Path | None, cache: Path) -> None:
        """Let packages come from this index, or from a folder of ``wheels`` alone, in which case uv never uses the
        network. ``cache`` is where uv unpacks. Raises PlgsError if the folder is missing."""
        found = uv_program.variables(os.environ, index_url) | {"UV_CACHE_DIR": str(cache)}
        if wheels is not None:
            if not wheels.is_dir():
                fix = "Make it on a computer with a network: python -m engine set-up FOLDER --download DIR."
                raise PlgsError("no-wheels", "there is no such folder of wheels", wheels, fix, option="--wheels")
            found = {name: value for name, value in found.items() if name not in ("UV_DEFAULT_INDEX", "UV_INDEX")}
            found |= {"UV_OFFLINE": "1", "UV_NO_INDEX": "1", "UV_PYTHON_DOWNLOADS": "never"}
            found["UV_FIND_LINKS"] = str(wheels.absolute())
        self._variables = found

    def _get_uv(self, tools: Path) -> Path:
        """Return uv's path in ``tools``; fetch it if missing. Raises PlgsError if that fails, or settings divert it."""
        if setting := uv_program.diverted(os.environ, self._cwd):
            fix = f"Remove it, or set UV_CONFIG_FILE to a file without it, then {self._again}"
            what = "a setting of uv keeps packages out of the engine's environment"
            raise PlgsError("uv-settings", what, setting, fix)
        uv = uv_program.program_in(tools)
        if not uv.exists():
            output, code = self._run([sys.executable, "-I", Path(uv_program.__file__), tools], self._variables)
            if code != 0:
                fix = f"Check the connection and the package index, then {self._again}"
                raise PlgsError("uv-download", complaint(output), tools, fix)
        return uv

    def _install(self, what: str, command: Sequence[str | Path], *, for_pip: bool = False) -> None:
        variables = uv_program.pip_variables(self._variables) if for_pip else self._variables
        output, code = self._run(command, variables)
        if code != 0:
            fix = f"Check the connection and the disk, then {self._again}"
            raise PlgsError("uv-failed", f"uv could not install {what} ({complaint(output)})", self.log_path, fix)

    def _refuse_full_disk(self, folder: Path, needed: float) -> None:
        free = shutil.disk_usage(folder).free
        if free < needed:
            what = f"the disk has {free / 1e9:.1f} GB free, but this needs {needed / 1e9:.1f} GB"
            raise PlgsError("disk-full", what, folder, f"Make room, then {self._again}", code=ErrorCode.DISK_FULL)

    def _run(
        self,
        command: Sequence[str | Path],
        environment: Mapping[str, str] | None = None,
        *,
        cwd: Path | None = None,
        limit_s: float | None = None,
    ) -> tuple[str, int]:
        """Run a program and return its output and its exit code. When the task is stopped, the program ends with its
        children. The program holds the lock too: if this process is killed, no other set-up begins before the program
        has ended. Raises PlgsError if it cannot be started or does not end within ``limit_s`` seconds; Cancelled."""
        assert self._lock is not None
        began = time.monotonic()
        with self.log_path.open("ab") as log, self.log_path.open("rb") as reader:
            log.write(without_credentials(f"\n$ {' '.join(map(str, command))}\n").encode())
            log.flush()
            reader.seek(log.tell())
            process = ChildProcess(
                command, cwd=cwd or self._cwd, environment=environment or clean_environment(cwd), output=log,
                keep_open=[self._lock.descriptor],
            )  # fmt: skip
            output = line = ""
            try:
                while True:
                    code = process.exit_code()  # before its output is read, so that the last lines are in it
                    new = reader.read(_MOST_BYTES).decode(errors="replace")
                    output = (output + new)[-_MOST_BYTES:]
                    *whole, line = (line + new).split("\n")  # the last one may be incomplete yet
                    for each in map(str.strip, whole):
                        if each.startswith(("Downloading ", "Downloaded ", "Building ", "Prepared ")):
                            self._tell(self._step, "Writing the packages" if each.startswith("Prepared ") else each)
                    if code is not None and not new:
                        return output, code
                    if limit_s is not None and time.monotonic() - began > limit_s:
                        raise PlgsError("silent", "does not answer", command[0], "Choose another program.")
                    self._pause()
            finally:
                process.kill()

    def _tell(self, step: int, detail: str = "") -> None:
        """Report that step number ``step`` begins or, with ``detail``, what is done in it."""
        label = f"{self._labels[step - 1]}: {detail}" if detail else self._labels[step - 1]
        if (step, label) != (self._step, self._label):
            self._step, self._label = step, label
            self._events.stage(self._stage, step, len(self._labels), label)
            self._events.progress(self._stage, step - 1, len(self._labels))

    def _pause(self) -> None:
        """Wait a moment. Raises Cancelled if the task shall stop."""
        self._stop.check()
        time.sleep(_POLL_S)
