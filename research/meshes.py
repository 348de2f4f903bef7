"""How complete the meshes of a lift are as fused, as mended, and as cut, which `engine export --to mesh` writes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.export.cutting import cut_by_label
from engine.export.fusion import Ints, Surface
from engine.export.mending import open_edges, pieces
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
    heads = "sides with a neighbour | objects | pieces | sharp turns | beyond 1.5 x their box | diagonal / box's"
    yield f"| | {heads} |"
    yield "|---|---|---|---|---|---|---|"
    yield mesh_row("as fused", surface, label, boxes)
    surface, label = mended(surface, label)
    yield mesh_row("mended", surface, label, boxes)
    yield mesh_row("cut", *cut_by_label(surface, label), boxes)


def mesh_row(name: str, surface: Surface, label: NDArray[np.int64], boxes: Mapping[int, Instance]) -> str:
    """A row of the table: of the labels [V] of a surface's vertices, as `fused` has them, and the boxes by id."""
    sides = 3 * len(surface.triangles)
    closed = 1 - len(open_edges(surface.triangles)) / sides
    ratios, in_pieces, turns = list[float](), 0, 0
    for value, triangles in triangles_by_label(surface.triangles, label).items():
        box = boxes.get(value % MOST_INSTANCES)
        if box is not None and len(triangles) >= LEAST_TRIANGLES:
            part, _ = surface.of(triangles)
            ratios.append(_diagonal(part.xyz, box.yaw) / float(np.linalg.norm(box.size)))
            in_pieces += int(pieces(part.triangles, len(part.xyz)).max()) + 1
            turns += sharp_turns(surface, triangles)
    far = np.count_nonzero(np.array(ratios) > FAR)
    shape = f"{len(ratios)} | {in_pieces} | {turns}"
    return f"| {name} | {100 * closed:.2f} % | {shape} | {far} | {np.median(ratios or [0.0]):.2f} |"


def sharp_turns(surface: Surface, triangles: Ints) -> int:
    """How many turns of more than 60 degrees the rim of these triangles [T, 3] makes."""
    rim = open_edges(triangles)
    following = np.full(len(surface.xyz), -1)
    following[rim[:, 0]] = rim[:, 1]
    way = surface.xyz[rim[:, 1]] - surface.xyz[rim[:, 0]]
    on = surface.xyz[following[rim[:, 1]]] - surface.xyz[rim[:, 1]]
    cosine = (way * on).sum(axis=1) / np.maximum(np.linalg.norm(way, axis=1) * np.linalg.norm(on, axis=1), 1e-12)
    return int((cosine < 0.5).sum())


def _diagonal(xyz: NDArray[np.float32], yaw: float) -> float:
    """Diagonal in metres of the box around points [N, 3] that is turned by ``yaw`` radians about z."""
    turned = xyz[:, :2] @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return float(np.linalg.norm(np.concatenate([np.ptp(turned, axis=0), np.ptp(xyz[:, 2:], axis=0)])))
