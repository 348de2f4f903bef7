"""Exports a lift's labelled points and Gaussians as PLY, and the objects' oriented boxes as JSON, as a table, and for
labelCloud and CVAT."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..gates import table_cell
from ..job import write_atomically
from ..passes.ply import columns_of, write_ply_table
from ..passes.previews import colour_picture
from ..result_files import Instance, SemanticPoints, write_arrays
from ..scene import ClassTable
from .frame_images import LEAST_COVERAGE, labels_text
from .source import FinishedLift
from .splat_files import splats_glb, spz_bytes

FIELDS = ("id", "name", "class_id", "class_name", "centre", "size", "yaw", "rotation", "score", "points", "views")
"""Fields of an `Instance` that are exported: metres in the world, z up; ``yaw`` in radians about +z, ``rotation`` the
same, wxyz."""
_AXES = {"centre": "xyz", "size": "xyz", "rotation": "wxyz"}


def export_boxes(lift: FinishedLift, output: Path) -> None:
    """boxes.json, boxes.csv (a column per number, such as size_x), labelcloud/, cvat/. Raises PlgsError, OSError."""
    boxes: list[dict[str, Any]] = [{field: getattr(one, field) for field in FIELDS} for one in lift.listed]
    content = {"up": "z", "unit": "m", "boxes": boxes}
    _write_json(output / "boxes.json", content)
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow([f"{field}_{axis}" if axis else field for field in FIELDS for axis in _AXES.get(field, ("",))])
    writer.writerows(
        [number for field in FIELDS for number in (box[field] if field in _AXES else [table_cell(box[field])])]
        for box in boxes
    )
    write_atomically(output / "boxes.csv", table.getvalue())
    points = lift.corrected.points
    xyz = columns_of("x y z", points.xyz)
    write_ply_table(output / "labelcloud/pointclouds/points.ply", xyz | columns_of("red green blue", points.rgb))
    _write_json(output / "labelcloud/labels/points.json", _for_labelcloud(lift.listed))
    _write_pcd(output / "cvat/ds0/pointcloud/points.pcd", points.xyz, points.rgb)
    for name, content in _for_cvat(lift.listed, lift.classes).items():
        _write_json(output / "cvat" / name, content)


def _for_labelcloud(boxes: Sequence[Instance]) -> dict[str, Any]:
    """labelCloud's format centroid_abs: the centre in metres, angles in degrees."""
    objects = [
        {
            "name": one.class_name,
            "centroid": dict(zip("xyz", one.centre, strict=True)),
            "dimensions": dict(zip(("length", "width", "height"), one.size, strict=True)),
            "rotations": {"x": 0, "y": 0, "z": math.degrees(one.yaw) % 360},
        }
        for one in boxes
    ]
    return {"folder": "pointclouds", "filename": "points.ply", "path": "pointclouds/points.ply", "objects": objects}


def _for_cvat(boxes: Sequence[Instance], classes: ClassTable) -> dict[str, Any]:
    """A Supervisely point cloud's files by path, which CVAT imports as cuboids. The tag "instance" is the name."""
    objects, figures, ids = [], [], {}
    for one in boxes:
        key = _key(one.id)
        ids[key] = one.id
        tag = {"name": "instance", "value": one.name, "key": key}
        objects.append({"key": key, "classTitle": one.class_name, "tags": [tag]})
        turn = {"x": 0.0, "y": 0.0, "z": one.yaw}
        position, size = (dict(zip("xyz", values, strict=True)) for values in (one.centre, one.size))
        box = {"position": position, "rotation": turn, "dimensions": size}
        figures.append({"key": key, "objectKey": key, "geometryType": "cuboid_3d", "geometry": box})
    known = [{"title": each.name, "shape": "cuboid_3d", "color": "#" + bytes(each.colour).hex(), "geometry_config": {}}
             for each in classes.categories]  # fmt: skip
    return {
        "meta.json": {
            "classes": known,
            "tags": [{"name": "instance", "value_type": "any_string", "color": "#ffffff"}],
            "projectType": "point_clouds",
        },
        "key_id_map.json": {"tags": ids, "objects": ids, "figures": ids, "videos": {_key(0): 0}},
        "ds0/ann/points.pcd.json": {
            "description": "",
            "key": _key(0),
            "tags": [],
            "objects": objects,
            "figures": figures,
        },  # fmt: skip
    }


def _key(number: int) -> str:
    """A key of 32 digits, as in Supervisely's files."""
    return f"{number:032x}"


def _write_json(path: Path, content: object) -> None:
    write_atomically(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def _write_pcd(path: Path, xyz: NDArray[np.float32], rgb: NDArray[np.uint8]) -> None:
    """Write points [N, 3] in metres with colours as the Point Cloud Library packs them. Raises OSError."""
    packed = np.zeros((len(rgb), 4), np.uint8)
    packed[:, :3] = rgb[:, ::-1]  # 0x00RRGGBB, with the lowest byte first
    rows = np.concatenate([xyz.astype("<f4"), packed.view("<f4")], axis=1)
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    write_atomically(path, head.encode() + rows.tobytes())


NEIGHBOURS = 30  # the number of nearest points that a normal is fitted to


def export_points(lift: FinishedLift, output: Path) -> None:
    """points.ply: semantic points with colours, normals, ids and confidence. Raises PlgsError, OSError."""
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
    """splats.ply: the wanted Gaussians as the authors of 3D Gaussian Splatting write them (colour as spherical
    harmonics of degree 0, logit of opacity, logarithm of scale, rotation wxyz), with class_id and instance_id, all
    floats. splats.spz, in the same order without ids, and splats.glb: see `splat_files`. labels.json names ids. Raises
    PlgsError, OSError."""
    rows = lift.splats
    write_ply_table(output / "splats.ply", {name: rows[name].astype(np.float32) for name in rows.dtype.names or ()})
    write_atomically(output / "splats.spz", spz_bytes(rows))
    if len(rows):  # glTF has no empty arrays
        write_atomically(output / "splats.glb", splats_glb(rows))
    write_atomically(output / "labels.json", labels_text(lift.classes, lift.instances))


def export_clouds(lift: FinishedLift, output: Path) -> None:
    """<name>.npz: what each camera sees of the lift, as semantic points in the world. Raises PlgsError, OSError."""
    for name, camera, layers in lift.shown("combined", "depth", "semantic", "instance", "confidence"):
        height, width = layers.depth.shape
        seen = (layers.combined[..., 3] >= LEAST_COVERAGE) & (layers.depth > 0)
        xyz = camera.resized(width, height).unproject(layers.depth)[seen].astype(np.float32)
        labels = (layers.semantic[seen], layers.instance[seen], layers.confidence[seen])
        write_arrays(output / f"{name}.npz", SemanticPoints(xyz, colour_picture(layers)[seen], *labels), fast=True)


def point_normals(xyz: NDArray[np.float32], centres: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit normals of points [N, 3] from their neighbours, towards the nearest camera centre [F, 3], float32 [N, 3]."""
    from open3d.geometry import KDTreeSearchParamKNN, PointCloud
    from open3d.utility import Vector3dVector
    from scipy.spatial import KDTree

    cloud = PointCloud(Vector3dVector(xyz.astype(np.float64)))
    cloud.estimate_normals(KDTreeSearchParamKNN(NEIGHBOURS), fast_normal_computation=False)  # fast is less stable
    normals = np.asarray(cloud.normals).reshape(-1, 3)
    _, nearest = KDTree(centres).query(xyz)
    away = ((centres[nearest] - xyz) * normals).sum(axis=1) < 0
    return np.where(away[:, None], -normals, normals).astype(np.float32)
