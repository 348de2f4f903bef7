"""The labelled points and Gaussians of a lift, as PLY."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import write_atomically
from ..passes.ply import columns_of, relabelled_splats, write_ply_table
from ..passes.previews import colour_picture
from ..result_files import SemanticPoints, write_arrays
from .frame_images import LEAST_COVERAGE
from .source import FinishedLift

NEIGHBOURS = 30
"""Nearest points that a normal is fitted to."""
_AT_ONCE = 100_000
"""Points whose normals are fitted at once."""


def export_points(lift: FinishedLift, output: Path) -> None:
    """points.ply: the semantic points with colours, normals, class_id, instance_id and confidence; gaussians.ply: the
    Gaussians, class_id and instance_id included. Raises PlgsError, OSError."""
    points = lift.corrected.points
    centres = np.array([frame.camera.centre for frame in lift.scene.frames])
    columns = {
        **columns_of("x y z", points.xyz),
        **columns_of("nx ny nz", point_normals(points.xyz, centres)),
        **columns_of("red green blue", points.rgb),
        **{name: getattr(points, name) for name in ("class_id", "instance_id", "confidence")},
    }
    write_ply_table(output / "points.ply", columns)
    content = (lift.folder.result_path / "gaussians.ply").read_bytes()
    if lift.corrected.changes_labels:
        content = relabelled_splats(content, lift.corrected.ids)
    write_atomically(output / "gaussians.ply", content)


def export_clouds(lift: FinishedLift, output: Path) -> None:
    """<name>.npz: what a frame's camera, or any other, sees of the lift, pixel by pixel in the world, as semantic
    points. Raises PlgsError for bad cameras, OSError."""
    for name, camera, layers in lift.shown():
        height, width = layers.depth.shape
        seen = (layers.combined[..., 3] >= LEAST_COVERAGE) & (layers.depth > 0)
        xyz = camera.resized(width, height).unproject(layers.depth)[seen].astype(np.float32)
        labels = (layers.semantic[seen], layers.instance[seen], layers.confidence[seen])
        write_arrays(output / f"{name}.npz", SemanticPoints(xyz, colour_picture(layers)[seen], *labels))


def point_normals(xyz: NDArray[np.float32], centres: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit normals of points [N, 3] from their neighbours, towards the nearest camera centre [F, 3], float32 [N, 3]."""
    from scipy.spatial import KDTree

    tree = KDTree(xyz)
    parts = [_flattest(xyz, tree.query(some, min(NEIGHBOURS, len(xyz)))[1]) for some in _in_parts(xyz)]
    normals = np.concatenate([np.empty((0, 3)), *parts])
    _, nearest = KDTree(centres).query(xyz)
    away = ((centres[nearest] - xyz) * normals).sum(axis=1) < 0
    return np.where(away[:, None], -normals, normals).astype(np.float32)


def _in_parts(xyz: NDArray[np.float32]) -> Iterator[NDArray[np.float32]]:
    """The points, so many at once that their neighbours take little memory."""
    return (xyz[start : start + _AT_ONCE] for start in range(0, len(xyz), _AT_ONCE))


def _flattest(xyz: NDArray[np.float32], neighbours: NDArray[np.int64]) -> NDArray[np.float64]:
    """The direction [M, 3] in which the neighbours [M, K] of each point spread the least."""
    near = xyz[neighbours.reshape(len(neighbours), -1)].astype(np.float64)
    near -= near.mean(axis=1, keepdims=True)
    directions: NDArray[np.float64] = np.linalg.eigh(near.transpose(0, 2, 1) @ near)[1]
    return directions[:, :, 0]  # eigenvalues ascend
