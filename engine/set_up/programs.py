"""The programs that a set-up runs: their output in its log, how uv is called, and what uv says."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ..errors import PlgsError
from ..gates import without_credentials
from ..job.process import ChildProcess
from . import uv_program

_MOST_BYTES = 200_000
"""Bytes of a program's output that are kept, counted from its end."""


def variables(index_url: str, wheels: Path | None) -> dict[str, str]:
    """uv's variables. With a folder of ``wheels`` uv installs only these, and never uses the network. Raises
    PlgsError if the folder is missing."""
    found = uv_program.variables(os.environ, index_url)
    if wheels is None:
        return found
    if not wheels.is_dir():
        fix = "Make it on a computer with a network: python -m engine set-up FOLDER --download DIR."
        raise PlgsError("no-wheels", "there is no such folder of wheels", wheels, fix, option="--wheels")
    kept = {name: value for name, value in found.items() if name not in ("UV_DEFAULT_INDEX", "UV_INDEX")}
    offline = {"UV_OFFLINE": "1", "UV_NO_INDEX": "1", "UV_PYTHON_DOWNLOADS": "never"}
    return kept | offline | {"UV_FIND_LINKS": str(wheels.absolute())}


def run(
    command: Sequence[str | Path],
    log_path: Path,
    environment: Mapping[str, str],
    pause: Callable[[], object],
    *,
    cwd: Path,
    read_line: Callable[[str], object],
    keep_open: Sequence[int],
    limit_s: float | None,
) -> tuple[str, int]:
    """Run a program whose output goes to a log, and return its output and its exit code.

    ``pause`` waits a moment. What it raises ends the program with its children. Raises PlgsError when the program
    cannot be started or does not end within ``limit_s`` seconds.
    """
    began = time.monotonic()
    with log_path.open("ab") as log, log_path.open("rb") as reader:
        log.write(without_credentials(f"\n$ {' '.join(map(str, command))}\n").encode())
        log.flush()
        reader.seek(log.tell())
        process = ChildProcess(command, cwd=cwd, environment=environment, output=log, keep_open=keep_open)
        output = line = ""
        try:
            while True:
                code = process.exit_code()  # before its output is read, so that the last lines are in it
                new = reader.read(_MOST_BYTES).decode(errors="replace")
                output = (output + new)[-_MOST_BYTES:]
                *whole, line = (line + new).split("\n")
                for each in whole:
                    read_line(each)
                if code is not None and not new:
                    return output, code
                if limit_s is not None and time.monotonic() - began > limit_s:
                    raise PlgsError("silent", "does not answer", command[0], "Choose another one.")
                pause()
        finally:
            process.kill()


def news_of_uv(line: str) -> str | None:
    """The progress that a line of uv's output reports; None when it reports none."""
    if line.startswith("Prepared "):
        return "Writing the packages"
    return line.strip() if line.strip().startswith(("Downloading ", "Downloaded ", "Building ")) else None


def complaint(output: str) -> str:
    """The first error in a program's output and what caused it, else its last line."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    first = next((index for index, line in enumerate(lines) if line.startswith("error:")), len(lines) - 1)
    said = [line.removeprefix("error:").removeprefix("cause:").strip() for line in lines[max(first, 0) :]]
    return without_credentials((": ".join(said) or "no reason given")[:300])


def refuse_diverted(folder: Path) -> None:
    """Raise PlgsError if the user's settings of uv would send packages elsewhere. ``folder`` is where uv runs."""
    if setting := uv_program.diverted(os.environ, folder):
        fix = "Remove it, or set UV_CONFIG_FILE to a file without it, then set up the engine again."
        raise PlgsError("uv-settings", "a setting of uv keeps packages out of the engine's environment", setting, fix)
