"""The labelled points and Gaussians of a lift, as PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import write_atomically
from ..passes.ply import columns_of, relabelled_splats, write_ply_table
from .source import FinishedLift

NEIGHBOURS = 30
"""Nearest points that a normal is fitted to."""


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


def point_normals(xyz: NDArray[np.float32], centres: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit normals of points [N, 3] from their neighbours, towards the nearest camera centre [F, 3], float32 [N, 3]."""
    import open3d
    from scipy.spatial import KDTree

    if not len(xyz):
        return np.empty((0, 3), np.float32)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz.astype(np.float64)))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    normals = np.asarray(cloud.normals)
    _, nearest = KDTree(centres).query(xyz)
    away = ((centres[nearest] - xyz) * normals).sum(axis=1) < 0
    return np.where(away[:, None], -normals, normals).astype(np.float32)
