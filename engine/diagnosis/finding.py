"""What a diagnosis says: findings, and what would mend those that can be mended without a doubt."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .reprojection import Assumption
from .trials import Agreement

Severity = Literal["wrong", "note"]
"""A note is about pictures and labels as captures have them; what is wrong should be mended before a lift."""


@dataclass(frozen=True, eq=False)
class Finding:
    """``cause`` names it in a word or two; ``text`` says what is wrong with its figures, ``figures`` gives them to
    programs; ``option`` says what mends it, and ``is_mended`` whether ``--fix`` does. ``frames`` are those it is about,
    none for all. ``picture`` uint8 [H, W, 3] RGB shows it.
    """

    cause: str
    severity: Severity
    text: str
    option: str
    figures: Mapping[str, float | str] = field(default_factory=dict)
    is_mended: bool = False
    frames: tuple[str, ...] = ()
    picture: NDArray[np.uint8] | None = None

    def as_json(self) -> dict[str, Any]:
        """All but the picture, for programs."""
        return {
            "cause": self.cause,
            "severity": self.severity,
            "text": self.text,
            "option": self.option,
            "figures": dict(self.figures),
            "is_mended": self.is_mended,
            "frames": list(self.frames),
        }


@dataclass(frozen=True, eq=False)
class Mending:
    """What has to be done to a scene: ``assumed`` is what its poses, depth and lenses mean; depth is moved by
    ``depth_shift`` (x, y in shares of the picture); the world is turned by ``turn`` float64 [3, 3]; the frames
    ``dropped`` are left out.
    """

    assumed: Assumption = Assumption()
    depth_shift: tuple[float, float] = (0.0, 0.0)
    turn: NDArray[np.float64] | None = None
    dropped: frozenset[str] = frozenset()

    @property
    def is_needed(self) -> bool:
        return bool(
            self.assumed != Assumption() or self.depth_shift != (0.0, 0.0) or self.turn is not None or self.dropped
        )


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Findings, the worst first. ``looked`` of ``frames`` frames were compared. ``agreement`` is that of the views as
    the scene is, None where there is no depth to compare.
    """

    findings: tuple[Finding, ...]
    mending: Mending
    frames: int
    looked: int
    agreement: Agreement | None
