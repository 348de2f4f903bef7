"""The programs that a set-up runs: their output in its log, how pip is called, and what pip says."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ..errors import PlgsError
from ..gates import without_credentials
from ..job.process import ChildProcess, clean_environment

CPU_BUILDS = "https://download.pytorch.org/whl/cpu"
"""PyTorch's public index. On Linux PyPI's builds bring several GB of CUDA; on other systems they are CPU builds."""
INSTALLING = "Installing collected packages"
"""The line of pip's output after which it writes into the environment."""
_ELSEWHERE = ("PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_CONSTRAINT", "PIP_REQUIREMENT", "VIRTUAL_ENV")
"""Variables that would send packages somewhere other than into the environment."""
_NEWS = re.compile(r"^\s*(Collecting|Downloading|Using cached|Installing collected packages)[: ]+(\S+)(?:.*(\(.*\)))?")
_MOST_BYTES = 200_000
"""Bytes of a program's output that are kept, counted from its end."""
_OPTIONS = ["--only-binary", ":all:", "--no-compile", "--no-color", "--progress-bar", "off"]


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


def pip_environment(temporary: Path, index_url: str = "") -> dict[str, str]:
    """This process's environment for pip. The user's indexes, proxies, certificates and hash policy stay; downloads go
    to ``temporary``, where they are measured and cleaned up.

    ``index_url`` takes the place of PyPI; empty leaves it to pip's configuration. It is not passed to pip as an
    argument, since its password would then show in the log and in the list of processes.
    """
    kept = {name: value for name, value in clean_environment().items() if name not in _ELSEWHERE}
    ours = {"PIP_USER": "0", "PIP_DISABLE_PIP_VERSION_CHECK": "1", "PIP_NO_INPUT": "1"}
    if index_url:
        ours["PIP_INDEX_URL"] = index_url
    return kept | ours | {"TMPDIR": str(temporary), "TEMP": str(temporary), "TMP": str(temporary)}


def install_command(
    python: Path, requirements: Sequence[str], constraints: Path, options: Sequence[str] = ()
) -> list[str | Path]:
    """The command that installs pinned packages as wheels: nothing is compiled."""
    return [python, "-I", "-m", "pip", "install", *_OPTIONS, *options, "--constraint", constraints, *requirements]


def install_pip_command(python: Path, wheel: Path) -> list[str | Path]:
    """The command that lets pip's ``wheel``, which runs as it is, install itself."""
    return [python, "-I", wheel / "pip", "install", "--no-index", "--no-color", wheel]


def install_hashed_command(python: Path, hashes: Path) -> list[str | Path]:
    """The command that installs exactly the files whose hashes the file ``hashes`` has."""
    return [python, "-I", "-m", "pip", "install", *_OPTIONS, "--no-deps", "--require-hashes", "--requirement", hashes]


def add_command(python: Path, hashes: Path, target: Path) -> list[str | Path]:
    """The command that installs into ``target`` exactly the files whose hashes the file ``hashes`` has. A package that
    has no wheel for this system is compiled.
    """
    options = ["--no-deps", "--no-compile", "--no-color", "--progress-bar", "off", "--prefer-binary"]
    return [
        python, "-I", "-m", "pip", "install", *options, "--require-hashes", "--requirement", hashes, "--target", target
    ]  # fmt: skip


def torch_options(index_url: str, torch_build: str) -> list[str]:
    """Options for torch, which is installed without its dependencies: only torch should come from the index of CPU
    builds."""
    if not index_url and torch_build == "cpu" and sys.platform == "linux":
        return ["--no-deps", "--extra-index-url", CPU_BUILDS]
    return ["--no-deps"]


def news_of_pip(line: str) -> str | None:
    """The progress that a line of pip's output reports, shortened; None when it reports none."""
    match = _NEWS.match(line)
    if match is None:
        return None
    verb, name, size = match.groups()
    if verb == INSTALLING:
        return "Writing the packages"
    package = re.split(r"[=<>!~\[;]", name.rpartition("/")[2].partition("-")[0])[0]
    return f"{verb} {package} {size or ''}".rstrip()


def complaint(output: str) -> str:
    """The first error in a program's output, else its last line."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line.removeprefix("ERROR:").strip() for line in lines if line.startswith("ERROR:")]
    return without_credentials((errors or lines or ["no reason given"])[0 if errors else -1][:300])
