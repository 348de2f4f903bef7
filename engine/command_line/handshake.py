"""What this engine is and what it lacks. It imports nothing heavy and takes a few tenths of a second."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
import sys
from pathlib import Path

from .. import __version__
from ..job.handshake import CAPABILITIES, Capability, EngineAnswer
from ..job.process import ROOT
from ..job.requirements import module_of, needed_packages
from ..job.system import usable_cpus

_CUDA = re.compile(r"^cuda\b[^=]*= *['\"]([^'\"]+)['\"]", re.MULTILINE)


def answer(root: Path = ROOT) -> EngineAnswer:
    """The answer about this Python. Raises PlgsError if the requirements cannot be read."""
    wanted = needed_packages(root, sys.version_info[:2])
    packages, cuda = {name: _version(name) for name in wanted}, _cuda_of_torch()
    missing = [name for name, version in packages.items() if version is None]
    return EngineAnswer(
        engine=__version__,
        python=".".join(map(str, sys.version_info[:3])),
        executable=Path(sys.executable),
        packages=packages,
        wanted=wanted,
        cpus=usable_cpus(),
        cuda=cuda,
        capabilities={name: (*missing, *_lacking(each, cuda)) for name, each in CAPABILITIES.items()},
    )


def _lacking(capability: Capability, cuda: str | None) -> list[str]:
    """What an otherwise complete engine lacks for an ability."""
    modules = capability.packages.items()
    lacking = [package for package, module in modules if importlib.util.find_spec(module) is None]
    return [*lacking, *(["torch for CUDA"] if capability.needs_cuda and cuda is None else [])]


def _version(package: str) -> str | None:
    if importlib.util.find_spec(module_of(package)) is None:
        return None
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:  # another package installed the module, such as opencv-python
        return "unknown"


def _cuda_of_torch() -> str | None:
    """The version of CUDA, from the text of torch's version.py, as importing torch takes a second."""
    torch = importlib.util.find_spec("torch")
    if torch is None or torch.origin is None:
        return None
    text = Path(torch.origin).with_name("version.py")
    found = _CUDA.search(text.read_text(encoding="utf-8")) if text.is_file() else None
    return found.group(1) if found else None
