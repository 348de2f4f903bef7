"""The labelled points and Gaussians of a lift, as PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import write_atomically
from ..passes.ply import columns_of, write_ply_table
from ..passes.previews import colour_picture
from ..result_files import SemanticPoints, write_arrays
from .frame_images import LEAST_COVERAGE, labels_text
from .source import FinishedLift

NEIGHBOURS = 30
"""The number of nearest points that a normal is fitted to."""


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
    _write_splats(output / "gaussians.ply", lift)


def export_splats(lift: FinishedLift, output: Path) -> None:
    """splats.ply: the wanted Gaussians as the authors of 3D Gaussian Splatting write them (colour as spherical
    harmonics of degree 0, logit of opacity, logarithm of scale, rotation wxyz), and class_id and instance_id.
    labels.json names these ids. Raises PlgsError, OSError."""
    _write_splats(output / "splats.ply", lift)
    write_atomically(output / "labels.json", labels_text(lift.classes, lift.instances))


def _write_splats(path: Path, lift: FinishedLift) -> None:
    write_ply_table(path, {name: lift.splats[name] for name in lift.splats.dtype.names or ()})


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
    from open3d.geometry import KDTreeSearchParamKNN, PointCloud
    from open3d.utility import Vector3dVector
    from scipy.spatial import KDTree

    cloud = PointCloud(Vector3dVector(xyz.astype(np.float64)))
    cloud.estimate_normals(KDTreeSearchParamKNN(NEIGHBOURS), fast_normal_computation=False)
    normals = np.asarray(cloud.normals).reshape(-1, 3)
    _, nearest = KDTree(centres).query(xyz)
    away = ((centres[nearest] - xyz) * normals).sum(axis=1) < 0
    return np.where(away[:, None], -normals, normals).astype(np.float32)
