"""What is known of an environment that is being made: kept in its folder, for whoever goes on with it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

_FILE = "set-up.json"


@dataclass
class Notes:
    """``done``: the finished steps. ``installing``: pip has begun to write packages, which can be half-written now."""

    torch_build: str
    done: list[str] = field(default_factory=list)
    installing: bool = False

    @classmethod
    def read(cls, environment: Path) -> Notes | None:
        """The notes of an environment; None where there are none, as when its making was cut off early."""
        try:
            data = json.loads((environment / _FILE).read_text(encoding="utf-8"))
            return cls(str(data["torch_build"]), [str(step) for step in data["done"]], bool(data["installing"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, environment: Path) -> None:
        """By rename, so that a kill leaves the old ones or the new. Not flushed to the disk: while pip writes, that
        could keep Blender's window waiting for seconds.
        """
        part = environment / f"{_FILE}.part"
        part.write_text(json.dumps(asdict(self)), encoding="utf-8")
        part.replace(environment / _FILE)
