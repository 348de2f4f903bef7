"""Parts of the method that a preset chooses by name and a script can add: matchers, losses and heads.

Functions and classes are registered where they belong (``engine/lift/objects.py``, ``engine/train/trainer.py``,
``engine/model/decoders.py``). This module has what these share. Standard library only."""

from __future__ import annotations

import hashlib
import inspect
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from ..errors import PlgsError, did_you_mean

Part = TypeVar("Part", bound=Callable)
_ADDED: dict[str, list[str]] = {}


def added_names(kind: str) -> list[str]:
    """Return the names of the parts of this kind ("matcher", "loss", "head") that scripts added in this process."""
    return _ADDED.get(kind, [])


def is_name(value: object) -> bool:
    """Whether a value can be the name of a part: letters, digits and underscores."""
    return isinstance(value, str) and re.fullmatch(r"\w+", value) is not None


class Parts(dict[str, Part]):
    """The parts of one ``kind``, by name."""

    def __init__(self, kind: str, built_in: dict[str, Part]) -> None:
        super().__init__(built_in)
        self.kind, self._built_in = kind, tuple(built_in)

    def register(self, name: str, part: Part) -> None:
        """Add a part, or replace one that was added. Raises ValueError for the name of a built-in part, and for a name
        with anything but letters, digits and underscores."""
        if not is_name(name) or name in self._built_in:
            raise ValueError(f"{name!r} is not a valid name for an added {self.kind}")
        self[name] = part
        _ADDED.setdefault(self.kind, []).append(name)

    def chosen(self, name: str) -> Part:
        """Return the part with this name. Raises PlgsError if this process has none."""
        if name not in self:
            fix = f"{did_you_mean(name, self)}Choose one of {', '.join(self)}, or run the script that registers it."
            raise PlgsError("no-part", f"there is no {self.kind} {name!r}", "", fix)
        return self[name]

    def sources(self, names: Iterable[str]) -> dict[str, str]:
        """Return a digest of the source file for each of these parts that was added: eight hexadecimal digits, or
        "unknown" for a part that comes from no file. Raises PlgsError for a name that this process does not have."""
        own = {name: self.chosen(name) for name in names}
        return {f"{self.kind} {name}": _digest(part) for name, part in own.items() if name not in self._built_in}


def _digest(part: Callable) -> str:
    try:
        return hashlib.sha256(Path(inspect.getsourcefile(part) or "").read_bytes()).hexdigest()[:8]
    except (OSError, TypeError):  # typed into a console, or not written in Python
        return "unknown"
