"""An engine's answer to the question what it is and what it lacks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from .. import __version__
from ..errors import PlgsError
from ..json_file import to_line
from ..records import record_of, refuse_other_format, to_json
from .capabilities import CAPABILITIES

VERSION = __version__
"""The version of the engine that comes with this extension."""
FORMAT = 2
"""The answer's format. If the numbers differ, an extension and an engine do not fit together."""
TOO_OLD = "the engine needs Python 3.11 or newer"
"""The message of ``python -m engine`` under an older Python."""


@dataclass(frozen=True)
class EngineAnswer:
    """An engine that answered. It works when nothing is missing.

    ``engine`` is its version. ``packages``: the names and versions of what it needs, with None if missing, and
    "unknown" if the version is not known. ``wanted``: the pinned versions, None if nothing is pinned for this Python.
    ``cuda``: the CUDA version that torch was built for, None for a CPU build or without torch. ``capabilities``: what
    each of `CAPABILITIES` lacks.
    """

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
        """Packages whose version is not the pinned one, as "name 1.0 instead of 2.0". They may work nevertheless."""
        return tuple(
            f"{name} {version} instead of {wanted}"
            for name, version in self.packages.items()
            if version is not None and (wanted := self.wanted.get(name)) and version.partition("+")[0] != wanted
        )

    @property
    def fix(self) -> str:
        """The command that installs what is missing; empty if nothing is."""
        pins = [f"{name}=={self.wanted[name]}" if self.wanted.get(name) else name for name in self.missing]
        return f"{self.executable} -m pip install {' '.join(pins)}" if pins else ""

    def to_json(self) -> dict[str, object]:
        """The answer as the engine gives it. Further values for the user are derived from the others."""
        told = {"missing": list(self.missing), "others": list(self.others), "fix": self.fix}
        return {"format": FORMAT, **to_json(self), **told}

    def to_line(self) -> bytes:
        return to_line(self.to_json())

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EngineAnswer | None:
        """The answer that `to_json` gave; None if it is something else, or an answer in another format."""
        known = {each.name for each in fields(cls)}
        try:
            refuse_other_format(dict(data), "", FORMAT)
            answer = record_of(cls, {name: value for name, value in data.items() if name in known}, "", "")
        except PlgsError:
            return None
        return answer if set(CAPABILITIES) <= set(answer.capabilities) else None

    @classmethod
    def from_line(cls, line: str) -> EngineAnswer | None:
        """The answer in a printed line; None if it is something else, or an answer in another format."""
        try:
            data = json.loads(line)
        except ValueError:
            return None
        return cls.from_json(data) if isinstance(data, dict) else None
