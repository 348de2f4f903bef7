"""What a scene's readers note besides its frames: what they inferred, and which frames they left out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from ..posed.plain_folders import left_out_warning


@dataclass(frozen=True)
class Inferred:
    """What no file says: ``taken`` instead, for a ``reason``. Where it ``is_doubtful``, it is a warning, too."""

    about: Literal[
        "format", "lens", "principal point", "depth's lens", "units", "axes", "numbering", "split", "up axis"
    ]  # fmt: skip
    taken: str
    reason: str
    is_doubtful: bool = True

    def __str__(self) -> str:
        return f"{self.taken}: {self.reason}"


@dataclass(frozen=True)
class LeftOut:
    """The ``names`` of frames that are left out, and what each of them ``lacks``."""

    lacks: str
    names: tuple[str, ...]

    def __str__(self) -> str:
        return left_out_warning(self.names, self.lacks)


def counted(left_out: Iterable[LeftOut]) -> list[dict[str, object]]:
    """Frames that are left out, for JSON."""
    return [{"lacks": each.lacks, "count": len(each.names), "names": list(each.names)} for each in left_out]


def doubts(inferred: Iterable[Inferred]) -> tuple[str, ...]:
    """The warnings of what was inferred."""
    return tuple(str(each) for each in inferred if each.is_doubtful)


def left_out(lacks: str, names: Iterable[str]) -> tuple[LeftOut, ...]:
    """A note that frames are left out; none where there are no ``names``."""
    found = tuple(names)
    return (LeftOut(lacks, found),) if found else ()
