"""How complete the meshes of a lift are, as `engine export --to mesh` writes them and before it mends them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.export.fusion import Surface
from engine.export.mending import open_edges
from engine.export.mesh import MOST_INSTANCES, fused, mended
from engine.export.source import FinishedLift
from engine.job import LiftFolder, verify_lifted
from engine.posed.labelled_surface import LEAST_TRIANGLES, triangles_by_label
from engine.result_files import Instance

FAR = 1.5
"""A mesh's diagonal may be this many times that of its object's box."""


def mesh_table(lift: Path) -> Iterator[str]:
    """Lines of Markdown. Raises PlgsError, OSError."""
    folder = LiftFolder.open(lift)
    verify_lifted(folder.result_path)
    source = FinishedLift(folder, ["all"])
    boxes = {instance.id: instance for instance in source.listed}
    surface, label = fused(source)
    yield "| | sides with a neighbour | objects | beyond 1.5 x their box | diagonal / box's, median |"
    yield "|---|---|---|---|---|"
    yield mesh_row("as fused", surface, label, boxes)
    yield mesh_row("mended", *mended(surface, label), boxes)


def mesh_row(name: str, surface: Surface, label: NDArray[np.int64], boxes: Mapping[int, Instance]) -> str:
    """A row of the table: of the labels [V] of a surface's vertices, as `fused` has them, and the boxes by id."""
    sides = 3 * len(surface.triangles)
    closed = 1 - len(open_edges(surface.triangles)) / sides
    ratios = list[float]()
    for value, triangles in triangles_by_label(surface.triangles, label).items():
        box = boxes.get(value % MOST_INSTANCES)
        if box is not None and len(triangles) >= LEAST_TRIANGLES:
            own = _diagonal(surface.xyz[np.unique(triangles)], box.yaw)
            ratios.append(own / float(np.linalg.norm(box.size)))
    far = np.count_nonzero(np.array(ratios) > FAR)
    return f"| {name} | {100 * closed:.2f} % | {len(ratios)} | {far} | {np.median(ratios or [0.0]):.2f} |"


def _diagonal(xyz: NDArray[np.float32], yaw: float) -> float:
    """Diagonal in metres of the box around points [N, 3] that is turned by ``yaw`` radians about z."""
    turned = xyz[:, :2] @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return float(np.linalg.norm(np.concatenate([np.ptp(turned, axis=0), np.ptp(xyz[:, 2:], axis=0)])))
