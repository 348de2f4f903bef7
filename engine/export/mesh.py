"""The lifted scene as meshes: rendered depth fused into one surface, cut into a mesh an instance and one a stuff class.

One truncated signed distance field takes all views (open3d's voxel blocks). Its surface's vertices are then labelled by
the views that see them: each votes with what it shows there. So the meshes meet where the labels change, without gaps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..job import write_atomically
from ..passes.layers import PanopticLayers, linear
from ..passes.ply import columns_of, write_ply_table
from ..passes.previews import colour_picture
from ..scene import Camera, ClassTable, Frame
from ..scene.classes import matte_names
from ..scene.labelled_surface import LEAST_TRIANGLES, triangles_by_label
from .glb import glb_bytes
from .source import FinishedLift

VOXEL = 0.02
"""Side of a voxel in metres."""
TRUNCATION = 4.0
"""Voxels on each side of the surface that a view changes."""
FARTHEST = 8.0
"""Metres beyond which rendered depth is not fused."""
LEAST_ALPHA = 0.7
"""Alpha below which a pixel's depth is no surface."""
WIDEST = 640
"""Width in pixels above which only every n-th pixel of a view is fused."""
SEEN_WITHIN = 0.05
"""Metres between a vertex and a view's depth there within which the view votes."""
MOST_INSTANCES = 1 << 16
"""Factor of the class in a label, which is class * this + instance."""


@dataclass(frozen=True, eq=False)
class Surface:
    """``xyz`` float32 [V, 3] m, ``rgb`` uint8 [V, 3], ``normal`` float32 [V, 3], ``triangles`` int64 [T, 3]."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    normal: NDArray[np.float32]
    triangles: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SmallView:
    """A view as it is fused: ``depth`` float32 [H, W] m, ``rgb`` uint8 [H, W, 3], ``label`` int64 [H, W]."""

    camera: Camera
    depth: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    label: NDArray[np.int64]


def export_mesh(lift: FinishedLift, output: Path) -> None:
    """mesh.ply, the whole surface with class_id and instance_id of every vertex, and meshes/<name>.glb, one an instance
    and one a stuff class (glTF's axes, y up). Raises PlgsError where no surface was rendered, OSError."""
    small = [_small(frame, layers) for frame, layers in lift.views()]
    surface = fuse(small)
    if not len(surface.triangles):
        fix = "Export more frames, or lift the scene with better depth."
        raise PlgsError("the rendered views show no surface", output, fix)
    label = vertex_labels(surface.xyz, small)
    class_id, instance_id = np.divmod(label, MOST_INSTANCES)
    columns = {
        **columns_of("x y z", surface.xyz),
        **columns_of("nx ny nz", surface.normal),
        **columns_of("red green blue", surface.rgb),
        **{"class_id": class_id.astype(np.int32), "instance_id": instance_id.astype(np.int32)},
    }
    write_ply_table(output / "mesh.ply", columns, surface.triangles)
    names = label_names(np.unique(label), lift.classes, lift.instances.names)
    for value, triangles in triangles_by_label(surface.triangles, label).items():
        if value in names and len(triangles) >= LEAST_TRIANGLES:
            content = _glb(names[value], surface, triangles)
            write_atomically(output / "meshes" / f"{names[value]}.glb", content)


def _small(frame: Frame, layers: PanopticLayers) -> SmallView:
    """Every n-th pixel, from the middle of each n by n block."""
    n = max(1, round(frame.camera.width / WIDEST))
    pick = (slice(n // 2, None, n), slice(n // 2, None, n))
    depth = np.where(layers.combined[..., 3] >= LEAST_ALPHA, layers.depth, 0)[pick]
    label = layers.semantic.astype(np.int64) * MOST_INSTANCES + layers.instance
    height, width = depth.shape
    whole, half = frame.camera, 0.5 - (n // 2 + 0.5) / n
    camera = Camera(
        width, height, whole.fx / n, whole.fy / n, whole.cx / n + half, whole.cy / n + half, whole.camera_to_world
    )
    rgb = colour_picture(layers)[pick]
    return SmallView(camera, np.ascontiguousarray(depth, np.float32), np.ascontiguousarray(rgb), label[pick])


def fuse(views: list[SmallView]) -> Surface:
    """The zero level of the truncated signed distance field of all views."""
    import open3d

    core: Any = open3d.core  # its stubs want a dtype and a device of what has them
    new_grid: Any = open3d.t.geometry.VoxelBlockGrid  # and shapes in a type of their own
    grid = new_grid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(core.float32, core.float32, core.float32),
        attr_channels=((1,), (1,), (3,)),
        voxel_size=VOXEL,
        block_resolution=16,
        block_count=10_000,
    )
    for view in views:
        depth = open3d.t.geometry.Image(core.Tensor(view.depth))
        colour = open3d.t.geometry.Image(core.Tensor(view.rgb.astype(np.float32) / 255))
        centred = view.camera.K
        centred[:2, 2] -= 0.5  # open3d's pixels have their centres at whole numbers
        lens, pose = core.Tensor(centred), core.Tensor(view.camera.world_to_camera)
        blocks = grid.compute_unique_block_coordinates(depth, lens, pose, 1.0, FARTHEST, TRUNCATION)
        if len(blocks):
            grid.integrate(blocks, depth, colour, lens, lens, pose, 1.0, FARTHEST, TRUNCATION)
    mesh = grid.extract_triangle_mesh(2.0).to_legacy()
    mesh.remove_degenerate_triangles()
    mesh.compute_vertex_normals()
    return Surface(
        np.asarray(mesh.vertices, np.float32),
        np.rint(np.clip(np.asarray(mesh.vertex_colors), 0, 1) * 255).astype(np.uint8),
        np.asarray(mesh.vertex_normals, np.float32),
        np.asarray(mesh.triangles, np.int64),
    )


def vertex_labels(xyz: NDArray[np.float32], views: list[SmallView]) -> NDArray[np.int64]:
    """The label that most views show at each vertex, of those whose depth is there; 0 where none is. int64 [V]."""
    known = np.unique(np.concatenate([np.unique(view.label) for view in views]))
    votes = np.zeros((len(xyz), len(known)), np.uint16)
    for view in views:
        pixel, depth = view.camera.project(xyz)
        column, row = (np.floor(pixel[:, axis]).astype(np.int64) for axis in (0, 1))
        inside = (depth > 0) & (column >= 0) & (column < view.camera.width) & (row >= 0) & (row < view.camera.height)
        vertex = np.flatnonzero(inside)
        row, column = row[vertex], column[vertex]
        seen = np.abs(view.depth[row, column] - depth[vertex]) < SEEN_WITHIN
        place = np.searchsorted(known, view.label[row[seen], column[seen]])
        votes[vertex[seen], place] += 1
    return np.where(votes.any(axis=1), known[votes.argmax(axis=1)], 0)


def label_names(labels: NDArray[np.int64], classes: ClassTable, instances: Mapping[int, str]) -> dict[int, str]:
    """File names of the labels: an instance's own, or its class's where it is none. Void has none."""
    names = {}
    for value in labels.tolist():
        class_id, instance = divmod(value, MOST_INSTANCES)
        if class_id in classes:
            names[value] = instances.get(instance, f"instance {instance}") if instance else classes[class_id].name
    safe = {value: "".join("-" if c in "<>:/|?*" else c for c in name) for value, name in matte_names(names).items()}
    return matte_names(safe)


def _glb(name: str, surface: Surface, triangles: NDArray[np.int64]) -> bytes:
    """The part of the surface that these triangles are."""
    used, corners = np.unique(triangles, return_inverse=True)
    xyz, normal = _upright(surface.xyz[used]), _upright(surface.normal[used])
    return glb_bytes(name, xyz, normal, linear(surface.rgb[used] / 255), corners.reshape(-1, 3))


def _upright(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """From z up to glTF's y up."""
    return values[:, (0, 2, 1)] * np.array([1, 1, -1], np.float32)
