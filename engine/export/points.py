"""Export a lift's labelled points and Gaussians as PLY, and the objects' oriented boxes as JSON and as a table."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..gates import table_cell
from ..job import write_atomically
from ..passes.ply import columns_of, write_ply_table
from ..passes.previews import colour_picture
from ..posed.layout import plural
from ..posed.ply import left_out
from ..result_files import SemanticPoints, write_arrays
from .frame_images import LEAST_COVERAGE, labels_text
from .source import FinishedLift
from .splat_files import LARGEST_OF_SPZ, columns, splats_glb, spz_bytes

FIELDS = ("id", "name", "class_id", "class_name", "centre", "size", "yaw", "rotation", "score", "points", "views")
"""Fields of an `Instance` that are exported: metres in the world, z up; ``yaw`` in radians about +z, ``rotation`` the
same, wxyz."""
_AXES = {"centre": "xyz", "size": "xyz", "rotation": "wxyz"}


def export_boxes(lift: FinishedLift, output: Path) -> None:
    """Write boxes.json and boxes.csv, with a column for each number. Raises PlgsError for a damaged lift, OSError."""
    boxes: list[dict[str, Any]] = [{field: getattr(one, field) for field in FIELDS} for one in lift.listed]
    content = {"up": "z", "unit": "m", "boxes": boxes}
    write_atomically(output / "boxes.json", json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow([f"{field}_{axis}" if axis else field for field in FIELDS for axis in _AXES.get(field, ("",))])
    writer.writerows(
        [number for field in FIELDS for number in (box[field] if field in _AXES else [table_cell(box[field])])]
        for box in boxes
    )
    write_atomically(output / "boxes.csv", table.getvalue())


NEIGHBOURS = 30  # the number of nearest points that a normal is fitted to


def export_points(lift: FinishedLift, output: Path) -> None:
    """Write points.ply: points with colours, normals, ids, confidence. Raises PlgsError for a damaged lift, OSError."""
    points = lift.corrected.points
    centres = np.array([frame.camera.centre for frame in lift.scene.frames])
    columns = {
        **columns_of("x y z", points.xyz),
        **columns_of("nx ny nz", point_normals(points.xyz, centres)),
        **columns_of("red green blue", points.rgb),
        **{name: getattr(points, name) for name in ("class_id", "instance_id", "confidence")},
    }
    write_ply_table(output / "points.ply", columns)


def export_splats(lift: FinishedLift, output: Path) -> None:
    """Write splats.ply: the Gaussians to export as the authors of 3D Gaussian Splatting write them (colour as spherical
    harmonics of degree 0, logit of opacity, logarithm of scale, rotation wxyz), with class_id and instance_id, all
    floats. Also write splats.spz, in the same order without ids, splats.glb (see `splat_files`), and labels.json with
    the ids' meaning. Raises PlgsError, OSError."""
    rows = lift.splats
    if lift.warn is not None:
        lost = left_out(lift.folder.result_path / "gaussians.ply")
        far = int((np.abs(columns(rows, "x y z")) >= LARGEST_OF_SPZ).any(axis=1).sum())
        if lost:
            lift.warn(f"{plural(lost, 'Gaussian')} with impossible numbers or positions: left out of all files")
        if far:
            lift.warn(f"{plural(far, 'Gaussian')} beyond {LARGEST_OF_SPZ} m: splats.spz holds no such position")
        if not len(rows):
            lift.warn("there is no Gaussian, so splats.glb is not written")
    write_ply_table(output / "splats.ply", {name: rows[name].astype(np.float32) for name in rows.dtype.names or ()})
    write_atomically(output / "splats.spz", spz_bytes(rows))
    if len(rows):  # glTF has no empty arrays
        write_atomically(output / "splats.glb", splats_glb(rows))
    write_atomically(output / "labels.json", labels_text(lift.classes, lift.instances))


def export_clouds(lift: FinishedLift, output: Path) -> None:
    """Write `SemanticPoints` as <name>.npz for each view, one for each pixel that shows a surface. Raises PlgsError for
    a damaged lift, OSError."""
    for name, camera, layers in lift.shown("combined", "depth", "semantic", "instance", "confidence"):
        height, width = layers.depth.shape
        seen = (layers.combined[..., 3] >= LEAST_COVERAGE) & (layers.depth > 0)
        xyz = camera.resized(width, height).unproject(layers.depth)[seen].astype(np.float32)
        labels = (layers.semantic[seen], layers.instance[seen], layers.confidence[seen])
        write_arrays(output / f"{name}.npz", SemanticPoints(xyz, colour_picture(layers)[seen], *labels), fast=True)


def point_normals(xyz: NDArray[np.float32], centres: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit normals float32 [N, 3] of points [N, 3] from their neighbours, facing the nearest of ``centres`` [F, 3]."""
    from open3d.geometry import KDTreeSearchParamKNN, PointCloud
    from open3d.utility import Vector3dVector
    from scipy.spatial import KDTree

    cloud = PointCloud(Vector3dVector(xyz.astype(np.float64)))
    cloud.estimate_normals(KDTreeSearchParamKNN(NEIGHBOURS), fast_normal_computation=False)  # fast is less stable
    normals = np.asarray(cloud.normals).reshape(-1, 3)
    _, nearest = KDTree(centres).query(xyz)
    away = ((centres[nearest] - xyz) * normals).sum(axis=1) < 0
    return np.where(away[:, None], -normals, normals).astype(np.float32)
