"""What a diagnosis says: findings, and what has to be done to the scene. findings.json and its pictures on disk."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..job.atomic import PART, write_atomically
from .pictures import png_bytes
from .reprojection import Assumption
from .trials import Agreement

FINDINGS = "findings.json"
FIX = "--fix OUT writes a scene in which it is mended"
"""The end of ``Finding.option`` where a mended scene needs no decision by the user."""

Severity = Literal["wrong", "note"]
""""wrong": mend it before a lift. "note": it is about pictures or labels, and a lift copes with it."""


@dataclass(frozen=True, eq=False)
class Finding:
    """One thing that is wrong with a scene.

    ``cause`` names it in a word or two. ``text`` says what is wrong, with figures; ``figures`` has these for programs.
    ``option`` says what mends it, and ``is_mended`` whether ``--fix`` does. ``frames`` names the frames concerned, and
    is empty for all frames; those of ``leave_out`` are better left out of a lift. ``picture`` uint8 [H, W, 3] RGB shows
    it.
    """

    cause: str
    severity: Severity
    text: str
    option: str
    figures: Mapping[str, float | str] = field(default_factory=dict)
    is_mended: bool = False
    frames: tuple[str, ...] = ()
    leave_out: tuple[str, ...] = ()
    picture: NDArray[np.uint8] | None = None

    def as_json(self) -> dict[str, Any]:
        """Everything but the picture."""
        return {
            "cause": self.cause,
            "severity": self.severity,
            "text": self.text,
            "option": self.option,
            "figures": dict(self.figures),
            "is_mended": self.is_mended,
            "frames": list(self.frames),
            "leave_out": list(self.leave_out),
        }


@dataclass(frozen=True, eq=False)
class Mending:
    """What has to be done to a scene.

    ``assumed`` says what its poses, depth and lenses mean. ``depth_shift`` moves depth (x, y in shares of the picture).
    ``turn`` float64 [3, 3] rotates the world. The frames in ``dropped`` are left out.
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
    """Findings, the worst first. ``looked`` of ``frames`` frames were examined. ``agreement`` tells how well the views
    of the scene agree as it is; it is None for scenes without depth. ``untested``: the axes of the world along which
    drift could not be tested.
    """

    findings: tuple[Finding, ...]
    mending: Mending
    frames: int
    looked: int
    agreement: Agreement | None
    untested: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Everything but the pictures."""
        views = self.agreement
        return {
            "frames": self.frames,
            "looked": self.looked,
            "agreement": None if views is None else {"seen": views.seen, "share": views.share, "error": views.error},
            "can_be_mended": self.mending.is_needed,
            "drift_untested_along": list(self.untested),
            "findings": [finding.as_json() for finding in self.findings],
        }


def write_findings(diagnosis: Diagnosis, folder: Path) -> dict[str, Any]:
    """Write findings.json and its pictures, and return its content. The folder must be new, empty, or hold nothing but
    earlier findings. Raises PlgsError.
    """
    try:
        if folder.exists() and any(folder.iterdir()) and not _holds_findings_only(folder):
            raise PlgsError("the folder for the findings holds other files", folder, "Name a new or an empty folder.")
        folder.mkdir(parents=True, exist_ok=True)
        entries = []
        for number, finding in enumerate(diagnosis.findings, start=1):
            entry = finding.as_json()
            if finding.picture is not None:
                entry["picture"] = f"{number}-{finding.cause.replace(' ', '-')}.png"
                write_atomically(folder / entry["picture"], png_bytes(finding.picture[..., ::-1]))
            entries.append(entry)
        written = {**diagnosis.as_json(), "findings": entries}
        write_atomically(folder / FINDINGS, json.dumps(written, indent=1))
        return written
    except OSError as error:
        what = f"the findings cannot be written ({error.strerror or error})"
        raise PlgsError(what, os.fspath(error.filename or folder), "Choose another folder.") from error


def _holds_findings_only(folder: Path) -> bool:
    """Whether all files are findings and their pictures ("1-depth-unit.png"), or parts left by a killed run."""
    names = [path.name.removeprefix(PART) for path in folder.iterdir()]
    return all(name == FINDINGS or re.fullmatch(r"\d+-[a-z-]+\.png", name) for name in names)
