"""The results of a diagnosis: findings with pictures, the corrections that the scene needs, and findings.json."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..job import write_atomically
from ..job.own_files import OwnFiles
from ..scene.pixels import image_bytes
from .reprojection import Assumption, Floats, Look, Views
from .trials import Agreement

Picture = NDArray[np.uint8]
_WIDTH = 480
_CAPTION = 22
_WORST = 0.2  # relative depth error drawn in the strongest red


def depth_errors(views: Views, one: int, other: int, assumed: Sequence[tuple[str, Assumption]]) -> Picture:
    """Draw how well the surfaces of look ``one`` agree with the depth of ``other``, once for each (caption,
    assumption). Green agrees, yellow and red do not, and dark is not seen by the other frame."""
    look = views.looks[one]
    height, width = look.depth.shape
    step = max(1, width // 240)
    rows, columns = np.meshgrid(np.arange(0, height, step), np.arange(0, width, step), indexing="ij")
    known = look.depth[rows, columns] > 0.0
    points = np.stack([columns[known], rows[known]], -1).astype(np.int32)
    pair = Views([replace(look, points=points), views.looks[other]], views.turn, views.recorded)
    panels = []
    for caption, assumption in assumed:
        error = np.full(rows.shape, np.nan)
        error[known] = np.abs(pair.compare(np.array([[0, 1]]), assumption).error[0, : len(points)])
        share = np.clip(np.nan_to_num(error, nan=0.0) / _WORST, 0.0, 1.0)
        red, green = np.clip(share * 4.0, 0.0, 1.0), np.clip(1.5 - 1.5 * share, 0.0, 0.75)
        colours = np.stack([red * 230, green * 255, np.full(share.shape, 40.0)], -1)
        colours = np.where(np.isfinite(error)[..., None], colours, 30.0).astype(np.uint8)
        panels.append(_captioned(_fitted(colours), caption))
    return np.concatenate(panels, axis=1)


def edges_on(grey: NDArray[np.uint8], edges: Floats, moved: Floats) -> Picture:
    """Draw depth's ``edges``, float64 [N, 2] as fractions of the picture, on the picture ``grey`` [H, W]: where they
    are, and ``moved`` to where they fit."""
    panels = []
    for caption, points in (("depth's edges as they lie", edges), ("where they fit", moved)):
        panel = np.repeat(_fitted(grey)[..., None] // 2 + 40, 3, axis=2)
        height, width = panel.shape[:2]
        columns, rows = (points * (width, height)).astype(np.int64).T
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        panel[rows[inside], columns[inside]] = (255, 90, 40)
        panels.append(_captioned(panel, caption))
    return np.concatenate(panels, axis=1)


def level_surfaces(look: Look, cosine: Floats, caption: str) -> Picture:
    """Draw a frame's points by the ``cosine`` [N] of their normals with up, level ones green, upright ones blue."""
    height, width = look.depth.shape
    far = max(float(look.depth.max()), 1e-6)
    panel = np.repeat((60.0 + 120.0 * look.depth[..., None] / far).astype(np.uint8), 3, axis=2)
    for (column, row), value in zip(look.points[: len(cosine)].tolist(), np.abs(cosine).tolist(), strict=True):
        size = max(1, width // 160)
        colour = (60, 220, 60) if value > 0.99 else (70, 110, 255) if value < 0.1 else (200, 200, 60)
        panel[max(0, row - size) : row + size + 1, max(0, column - size) : column + size + 1] = colour
    return _captioned(_fitted(panel), caption)


def side_by_side(pictures: Sequence[tuple[str, NDArray[np.uint8]]]) -> Picture:
    """Put pictures [H, W] or [H, W, 3] side by side, under their captions."""
    panels = [_captioned(_fitted(picture), caption) for caption, picture in pictures]
    height = max(len(panel) for panel in panels)
    return np.concatenate([np.pad(p, ((0, height - len(p)), (0, 0), (0, 0))) for p in panels], axis=1)


def _fitted(picture: NDArray[np.uint8]) -> Picture:
    """Return the picture, uint8 [H, W, 3], resized to a width of 480 pixels."""
    height, width = picture.shape[:2]
    size = (_WIDTH, max(1, round(height * _WIDTH / width)))
    shrinks = width > _WIDTH
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST)  # type: ignore[return-value]


def _captioned(picture: NDArray[np.uint8], caption: str) -> Picture:
    coloured = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    bar = np.full((_CAPTION, coloured.shape[1], 3), 20, np.uint8)
    cv2.putText(bar, caption, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (235, 235, 235), 1, cv2.LINE_AA)
    return np.ascontiguousarray(np.concatenate([bar, coloured]))


FINDINGS = "findings.json"
MEND = "'python -m engine inspect SCENE --fix OUT'"
FIX = f"{MEND} writes a scene in which it is mended"  # ends an ``option`` that needs no decision

Severity = Literal["wrong", "note"]  # "wrong": fix it before a lift; "note": a lift copes with it


@dataclass(frozen=True, eq=False)
class Finding:
    """One thing that is wrong with a scene. ``cause`` names it in a word or two. ``text`` says what is wrong, with
    numbers; ``figures`` has these for programs. ``option`` says how to fix it, and ``is_mended`` whether ``--fix``
    does. ``frames`` names the frames concerned, and is empty for all frames; those in ``leave_out`` are better left out
    of a lift. ``picture`` uint8 [H, W, 3] RGB shows it. ``stops``: a lift of the scene would be useless."""

    cause: str
    text: str
    option: str
    severity: Severity = "wrong"
    figures: Mapping[str, float | str] = field(default_factory=dict)
    is_mended: bool = False
    frames: tuple[str, ...] = ()
    leave_out: tuple[str, ...] = ()
    picture: NDArray[np.uint8] | None = None
    stops: bool = False

    def as_json(self) -> dict[str, Any]:
        """Return the finding as JSON, without picture and ``stops``."""
        said = {"cause": self.cause, "severity": self.severity, **vars(self)}  # in the order of findings.json
        return {name: value for name, value in said.items() if name not in ("picture", "stops")}


@dataclass(frozen=True, eq=False)
class Mending:
    """The corrections that a scene needs. ``assumed`` says what its poses, depth and lenses mean. ``depth_shift`` moves
    depth (x, y as fractions of the picture). ``turn`` float64 [3, 3] rotates the world. ``dropped``: frames to omit."""

    assumed: Assumption = Assumption()
    depth_shift: tuple[float, float] = (0.0, 0.0)
    turn: NDArray[np.float64] | None = None
    dropped: frozenset[str] = frozenset()

    @property
    def is_needed(self) -> bool:
        changes = (self.assumed != Assumption(), self.depth_shift != (0.0, 0.0), self.turn is not None, self.dropped)
        return any(changes)


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The result of a diagnosis: findings, the worst first. ``looked`` of ``frames`` frames were examined.
    ``agreement`` is how well the views of the unmodified scene agree, None without depth. ``untested`` are world axes
    along which no drift could be measured."""

    findings: tuple[Finding, ...]
    mending: Mending
    frames: int
    looked: int
    agreement: Agreement | None
    untested: tuple[str, ...] = ()

    @property
    def stopping(self) -> Finding | None:
        """Return the worst finding that makes a lift useless, or None."""
        return next((finding for finding in self.findings if finding.stops), None)

    def as_json(self) -> dict[str, Any]:
        """Return the diagnosis as JSON, without pictures."""
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
    """Write findings.json and the pictures, and return what findings.json holds. The folder must be new or empty, or
    hold findings, which are replaced. Raises PlgsError for other files in it, or if it cannot be written."""
    try:
        with OwnFiles(folder).begin("findings", {}, replaces=True) as own:
            entries = []
            for number, finding in enumerate(diagnosis.findings, start=1):
                entry = finding.as_json()
                if finding.picture is not None:
                    entry["picture"] = f"{number}-{finding.cause.replace(' ', '-')}.png"
                    write_atomically(folder / entry["picture"], image_bytes(finding.picture))
                entries.append(entry)
            written = {**diagnosis.as_json(), "findings": entries}
            write_atomically(folder / FINDINGS, json.dumps(written, indent=1))
            own.remove_earlier()
        own.complete()
        return written
    except OSError as error:
        what = f"the findings cannot be written ({error.strerror or error})"
        raise PlgsError("unwritable", what, os.fspath(error.filename or folder), "Choose another folder.") from error
