"""The answer of an engine that is asked what it is, and what it lacks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .. import __version__
from ..json_file import to_line
from .capabilities import CAPABILITIES

VERSION = __version__
"""The version of the engine that lies beside this extension."""
FORMAT = 2
"""The answer's format. With another number, an extension and an engine do not belong together."""
TOO_OLD = "the engine needs Python 3.11 or newer"
"""The message of ``python -m engine`` under an older Python."""


@dataclass(frozen=True)
class EngineAnswer:
    """An engine that answered. It works when nothing is missing.

    ``packages``: name and version of what it needs, None when missing, "unknown" when it is there without saying which.
    ``wanted``: the pinned version, None where nothing is pinned for this Python. ``cuda``: the CUDA version that torch
    was built for, None for a CPU build or without torch. ``capabilities``: what each of `CAPABILITIES` lacks.
    """

    version: str
    python: str
    executable: Path
    packages: Mapping[str, str | None]
    wanted: Mapping[str, str | None]
    cpus: int
    cuda: str | None
    capabilities: Mapping[str, tuple[str, ...]]

    @property
    def missing(self) -> tuple[str, ...]:
        """The packages that are not there."""
        return tuple(name for name, version in self.packages.items() if version is None)

    @property
    def others(self) -> tuple[str, ...]:
        """Packages in another version than the pinned one, as "name 1.0 instead of 2.0". It may work all the same."""
        return tuple(
            f"{name} {version} instead of {wanted}"
            for name, version in self.packages.items()
            if version is not None and (wanted := self.wanted.get(name)) and version.partition("+")[0] != wanted
        )

    @property
    def fix(self) -> str:
        """The command that installs what is missing; empty when nothing is."""
        pins = [f"{name}=={self.wanted[name]}" if self.wanted.get(name) else name for name in self.missing]
        return f"{self.executable} -m pip install {' '.join(pins)}" if pins else ""

    def to_json(self) -> dict[str, object]:
        """The answer as the engine gives it."""
        return {
            "format": FORMAT,
            "engine": self.version,
            "python": self.python,
            "executable": self.executable,
            "packages": self.packages,
            "wanted": self.wanted,
            "cpus": self.cpus,
            "cuda": self.cuda,
            "capabilities": {name: list(lacking) for name, lacking in self.capabilities.items()},
            "missing": list(self.missing),
            "others": list(self.others),
            "fix": self.fix,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EngineAnswer | None:
        """The answer that `to_json` gave; None when it is none, or one of another format."""
        try:
            if data["format"] != FORMAT:
                return None
            return cls(
                version=str(data["engine"]),
                python=str(data["python"]),
                executable=Path(data["executable"]),
                packages=_versions(data["packages"]),
                wanted=_versions(data["wanted"]),
                cpus=int(data["cpus"]),
                cuda=None if data["cuda"] is None else str(data["cuda"]),
                capabilities={name: tuple(map(str, data["capabilities"][name])) for name in CAPABILITIES},
            )
        except (ValueError, TypeError, KeyError, AttributeError):
            return None

    def to_line(self) -> bytes:
        return to_line(self.to_json())

    @classmethod
    def from_line(cls, line: str) -> EngineAnswer | None:
        """The answer in a line that was printed; None when it is none, or one of another format."""
        try:
            data = json.loads(line)
        except ValueError:
            return None
        return cls.from_json(data)


def _versions(data: Mapping[str, object]) -> dict[str, str | None]:
    return {str(name): None if version is None else str(version) for name, version in data.items()}
