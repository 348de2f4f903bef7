"""How pip is called, and what its output means."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

from ...engine.job.process import clean_environment

CPU_BUILDS = "https://download.pytorch.org/whl/cpu"
"""PyTorch's public index. On Linux PyPI's builds bring several GB of CUDA; on other systems they are CPU builds."""
# What would send packages elsewhere than into the environment.
_ELSEWHERE = ("PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_CONSTRAINT", "PIP_REQUIREMENT", "VIRTUAL_ENV")
_NEWS = re.compile(r"^\s*(Collecting|Downloading|Using cached|Installing collected packages)[: ]+(\S+)(?:.*(\(.*\)))?")
INSTALLING = "Installing collected packages"
"""What pip says when all is there and it begins to write into the environment."""


def environment(temporary: Path) -> dict[str, str]:
    """This process's environment for pip: the user's indexes, proxies and certificates stay, downloads go beside the
    environment, where they are measured and cleaned up.
    """
    kept = {name: value for name, value in clean_environment().items() if name not in _ELSEWHERE}
    ours = {"PIP_USER": "0", "PIP_REQUIRE_HASHES": "0", "PIP_DISABLE_PIP_VERSION_CHECK": "1", "PIP_NO_INPUT": "1"}
    return kept | ours | {"TMPDIR": str(temporary), "TEMP": str(temporary), "TMP": str(temporary)}


def install_command(
    python: Path, requirements: Sequence[str], constraints: Path, options: Sequence[str]
) -> list[str | Path]:
    """Install pinned packages, as wheels: nothing is compiled."""
    usual = ["--only-binary", ":all:", "--no-compile", "--no-color", "--progress-bar", "off"]
    return [python, "-m", "pip", "install", *usual, *options, "--constraint", constraints, *requirements]


def index_options(index_url: str) -> list[str]:
    """The given index in the place of PyPI; otherwise pip looks where it is configured to."""
    return ["--index-url", index_url] if index_url else []


def torch_options(index_url: str, torch_build: str) -> list[str]:
    """Torch alone, without what it needs: nothing else shall come from PyTorch's index of CPU builds."""
    if not index_url and torch_build == "cpu" and sys.platform == "linux":
        return ["--no-deps", "--extra-index-url", CPU_BUILDS]
    return ["--no-deps", *index_options(index_url)]


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
    return (errors or lines or ["no reason given"])[0 if errors else -1][:300]
