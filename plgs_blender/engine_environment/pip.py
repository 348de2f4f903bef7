"""How pip is called, and what its output means."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

from ...engine.gates import without_credentials
from ...engine.job.process import clean_environment

CPU_BUILDS = "https://download.pytorch.org/whl/cpu"
"""PyTorch's public index. On Linux PyPI's builds bring several GB of CUDA; on other systems they are CPU builds."""
# What would send packages elsewhere than into the environment.
_ELSEWHERE = ("PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_CONSTRAINT", "PIP_REQUIREMENT", "VIRTUAL_ENV")
_NEWS = re.compile(r"^\s*(Collecting|Downloading|Using cached|Installing collected packages)[: ]+(\S+)(?:.*(\(.*\)))?")
_USUAL = ["--only-binary", ":all:", "--no-compile", "--no-color", "--progress-bar", "off"]
INSTALLING = "Installing collected packages"
"""What pip says when all is there and it begins to write into the environment."""


def environment(temporary: Path, index_url: str = "") -> dict[str, str]:
    """This process's environment for pip: the user's indexes, proxies, certificates and hash policy stay, downloads go
    beside the environment, where they are measured and cleaned up.

    ``index_url`` takes the place of PyPI; empty leaves it to pip's configuration. It is given here, not as an argument:
    its password would stand in the log, and in the list of processes.
    """
    kept = {name: value for name, value in clean_environment().items() if name not in _ELSEWHERE}
    ours = {"PIP_USER": "0", "PIP_DISABLE_PIP_VERSION_CHECK": "1", "PIP_NO_INPUT": "1"}
    if index_url:
        ours["PIP_INDEX_URL"] = index_url
    return kept | ours | {"TMPDIR": str(temporary), "TEMP": str(temporary), "TMP": str(temporary)}


def install_command(
    python: Path, requirements: Sequence[str], constraints: Path, options: Sequence[str]
) -> list[str | Path]:
    """Install pinned packages, as wheels: nothing is compiled."""
    return [python, "-I", "-m", "pip", "install", *_USUAL, *options, "--constraint", constraints, *requirements]


def install_hashed_command(python: Path, hashes: Path) -> list[str | Path]:
    """Install the packages of a file that has their hashes: these very files and no others."""
    return [python, "-I", "-m", "pip", "install", *_USUAL, "--no-deps", "--require-hashes", "--requirement", hashes]


def torch_options(index_url: str, torch_build: str) -> list[str]:
    """Torch alone, without what it needs: nothing else shall come from PyTorch's index of CPU builds."""
    if not index_url and torch_build == "cpu" and sys.platform == "linux":
        return ["--no-deps", "--extra-index-url", CPU_BUILDS]
    return ["--no-deps"]


def news(line: str) -> str | None:
    """What a line of pip's tells about the progress, shortened; None when it tells nothing."""
    match = _NEWS.match(line)
    if match is None:
        return None
    verb, name, size = match.groups()
    if verb == INSTALLING:
        return "Writing the packages"
    package = re.split(r"[=<>!~\[;]", name.rpartition("/")[2].partition("-")[0])[0]
    return f"{verb} {package} {size or ''}".rstrip()


def complaint(output: str) -> str:
    """The first error that pip told, else its last line."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line.removeprefix("ERROR:").strip() for line in lines if line.startswith("ERROR:")]
    return without_credentials((errors or lines or ["no reason given"])[0 if errors else -1][:300])
