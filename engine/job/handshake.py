"""What an engine is, can do and lacks: how Blender asks this and gets the answer. It imports nothing heavy."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from .. import __version__
from ..errors import PlgsError
from ..records import record_of, refuse_other_format, to_json
from .environment import module_of, needed_packages
from .process import ROOT
from .system import usable_cpus

VERSION = __version__
"""The version of the engine that comes with this extension."""
FORMAT = 2
"""The answer's format. If the numbers differ, an extension and an engine do not fit together."""
TOO_OLD = "the engine needs Python 3.11 or newer"
"""The message of ``python -m engine`` under an older Python."""


@dataclass(frozen=True)
class EngineAnswer:
    """What an engine answered about itself. The engine works if nothing is missing. ``engine`` is its version.
    ``packages`` gives the version of each package that it needs, None if missing, "unknown" if the version cannot be
    found. ``wanted`` gives the pinned versions, None if nothing is pinned for this Python. ``cuda`` is the CUDA version
    that torch was built for, None for a CPU build or without torch. ``capabilities`` gives for each of `CAPABILITIES`
    what it lacks."""

    engine: str
    python: str
    executable: Path
    packages: Mapping[str, str | None]
    wanted: Mapping[str, str | None]
    cpus: int
    cuda: str | None
    capabilities: Mapping[str, tuple[str, ...]]

    @property
    def missing(self) -> tuple[str, ...]:
        """The packages that are not installed."""
        return tuple(name for name, version in self.packages.items() if version is None)

    @property
    def others(self) -> tuple[str, ...]:
        """Packages whose version is not the pinned one, as "name 1.0 instead of 2.0". They may work all the same."""
        return tuple(
            f"{name} {version} instead of {wanted}"
            for name, version in self.packages.items()
            # torch's builds have names such as 2.6.0+cpu.
            if version is not None and (wanted := self.wanted.get(name)) and version.partition("+")[0] != wanted
        )

    @property
    def fix(self) -> str:
        """The command that installs what is missing; empty if nothing is."""
        pins = [f"{name}=={self.wanted[name]}" if self.wanted.get(name) else name for name in self.missing]
        return f"uv pip install --python {self.executable} {' '.join(pins)}" if pins else ""

    def to_json(self) -> dict[str, object]:
        """Return the answer as JSON, with further values for the user that are derived from the fields."""
        derived = {"missing": list(self.missing), "others": list(self.others), "fix": self.fix}
        return {"format": FORMAT, **to_json(self), **derived}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EngineAnswer | None:
        """Return the answer from the JSON ``data`` of `to_json`; None if it is something else, or of another format."""
        known = {each.name for each in fields(cls)}
        try:
            refuse_other_format(dict(data), "", FORMAT)
            answer = record_of(cls, {name: value for name, value in data.items() if name in known}, "", "")
        except PlgsError:
            return None
        return answer if set(CAPABILITIES) <= set(answer.capabilities) else None

    @classmethod
    def from_line(cls, line: str) -> EngineAnswer | None:
        """Return the answer in a printed line; None if it is something else, or of another format."""
        try:
            data = json.loads(line)
        except ValueError:
            return None
        return cls.from_json(data) if isinstance(data, dict) else None


@dataclass(frozen=True)
class Capability:
    """An optional ability of the engine. ``packages`` are the modules that it needs besides those of every engine. If
    it has a ``size``, in bytes on disk, `python -m engine add` can install them from
    ``requirements/hashes-NAME.txt``."""

    label: str
    packages: Mapping[str, str]
    size: int = 0
    needs_cuda: bool = False


CAPABILITIES: dict[str, Capability] = {
    "lift": Capability("Lift", {}),
    "passes": Capability("Passes", {}),
    "meshes": Capability("Make Meshes", {}),
    "points": Capability("Labelled points", {}),
    "segment": Capability("Make Masks", {"transformers": "transformers", "pillow": "PIL"}, 130_000_000),
    "depth": Capability("Make Depth", {"transformers": "transformers", "pillow": "PIL"}),
    "record3d": Capability("Record3D's depth (.r3d)", {"pyliblzfse": "liblzfse"}, 1_000_000),
    "hypersim": Capability("Hypersim", {"h5py": "h5py"}, 16_000_000),
    "colmap": Capability("Poses of photos and films", {"pycolmap": "pycolmap"}, 134_000_000),
    "usd": Capability("OpenUSD", {"usd-core": "pxr"}, 209_000_000),
    "farm": Capability(
        "Batches on many machines", {"distributed": "distributed", "dask-jobqueue": "dask_jobqueue"}, 38_000_000
    ),
    "cuda": Capability("Lift on a GPU", {"gsplat": "gsplat"}, needs_cuda=True),
}
"""The abilities, by the names that the command line and scripts use. Sizes are those on Linux."""

ADDED = tuple(name for name, each in CAPABILITIES.items() if each.size)
"""The names of the abilities that can be added to an engine."""
ALSO_ADDED = {"depth": "segment"}
"""Abilities that need just the packages of another one, and come with it."""


_CUDA = re.compile(r"^cuda\b[^=]*= *['\"]([^'\"]+)['\"]", re.MULTILINE)


def answer(root: Path = ROOT) -> EngineAnswer:
    """Return what this Python is and can do as an engine. Raises PlgsError if the requirements cannot be read."""
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
    """Return what an engine that has all required packages still lacks for an ability."""
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
    """Return the CUDA version in torch's version.py, read as text, as importing torch is slow; None for a CPU build."""
    torch = importlib.util.find_spec("torch")
    if torch is None or torch.origin is None:
        return None
    text = Path(torch.origin).with_name("version.py")
    found = _CUDA.search(text.read_text(encoding="utf-8")) if text.is_file() else None
    return found.group(1) if found else None
