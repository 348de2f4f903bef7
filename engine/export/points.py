"""The labelled points and Gaussians of a lift, as PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import LiftFolder, write_atomically
from ..scene.array_file import read_npz
from .ply_tables import write_ply_table

NEIGHBOURS = 30
"""Points that a normal is fitted to."""


def write_points(output: Path, folder: LiftFolder, centres: NDArray[np.float64]) -> None:
    """points.ply: the semantic points with colours, normals, class_id, instance_id and confidence; gaussians.ply: the
    Gaussians as the lift has them, class_id and instance_id included. ``centres`` [F, 3]: the cameras', metres. Raises
    SceneError, OSError.
    """
    fix, labelled = "Lift the scene anew, into another folder.", ("class_id", "instance_id", "confidence")
    points = read_npz(folder.result_path / "semantic_points.npz", fix, ("xyz", "rgb", *labelled))
    xyz, rgb, labels = points["xyz"], points["rgb"], {name: points[name] for name in labelled}
    columns = {name: xyz[:, axis] for axis, name in enumerate("xyz")}
    normals = point_normals(xyz, centres)
    columns |= {name: normals[:, axis] for axis, name in enumerate(("nx", "ny", "nz"))}
    columns |= {name: rgb[:, channel] for channel, name in enumerate(("red", "green", "blue"))}
    write_ply_table(output / "points.ply", columns | labels)
    write_atomically(output / "gaussians.ply", (folder.result_path / "gaussians.ply").read_bytes())


def point_normals(xyz: NDArray[np.float32], centres: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit normals of points [N, 3] from their neighbours, towards the nearest of the cameras, float32 [N, 3]."""
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
