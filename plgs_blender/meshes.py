"""The lifted surface as meshes: one for each instance and each stuff class, in one collection per class."""

from __future__ import annotations

import re
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from ..engine.posed.ply import LabelledSurface, read_surface
from .boxes import name_object, set_faces
from .clouds import set_attributes
from .compat import forget_selection
from .materials import object_colour, surface_material
from .owned import LIFT, OwnedDataBlocks, Placed, child_collection, text_of
from .results import LiftResult

CORRECTIONS, _OF_MESHES = "plgs_corrections", "plgs_meshes_of"
"""Properties of a lift's collection: the fingerprints of the corrections that the scene and the meshes show."""
SURFACE = "surface"
"""The engine's export format for it."""
_COMMENT = re.compile(rb"^comment corrections ([0-9a-f]+)$", re.MULTILINE)
_LONGEST_HEADER = 8192


def mesh_folder(lift: Path) -> Path:
    """Return the folder into which the engine exports a lift's surface for Blender."""
    return lift / "exports" / SURFACE


@dataclass(frozen=True, eq=False)
class ReadMeshes:
    """A lift's surface as read: the part of each (class, instance), the fingerprint of the corrections when it was
    made, and the folder of its pictures, CLASS_INSTANCE.jpg."""

    parts: Mapping[tuple[int, int], LabelledSurface]
    corrections: str = ""
    pictures: Path = Path()


def reading_meshes(lift: Path) -> Generator[None, None, ReadMeshes]:
    """Read the lift's surface in parts, so that the window does not freeze. Raises PlgsError for a damaged file."""
    path = mesh_folder(lift) / "mesh.ply"
    if not path.is_file():
        return ReadMeshes({})
    surface, parts = read_surface(path), {}
    with path.open("rb") as file:
        fingerprint = _COMMENT.search(file.read(_LONGEST_HEADER).partition(b"end_header")[0])
    yield
    for label, rows in surface.parts().items():
        yield
        parts[label] = surface.cut(rows)
    return ReadMeshes(parts, fingerprint[1].decode() if fingerprint else "", path.parent / "pictures")


def placing_meshes(placed: Placed, result: LiftResult, read: ReadMeshes) -> Generator[None, None, int]:
    """Place a lift's meshes in parts, remove outdated ones, and return their number; 0 if the lift was removed."""
    instances = {one.id: one for one in result.instances}
    keys: list[str] = []
    for (class_id, instance_id), surface in read.parts.items():
        found = placed.find()
        if found is None:
            return 0
        if class_id not in result.classes or (instance_id and instance_id not in instances):
            continue
        (root, scene), kind = found, result.classes[class_id]
        root[_OF_MESHES] = read.corrections
        owned = OwnedDataBlocks(root[LIFT], scene)
        keys.append(f"mesh:{class_id}:{instance_id}")
        one = instances.get(instance_id, kind)
        mesh = _fill(owned, keys[-1], one.name, surface)
        picture = read.pictures / f"{class_id}_{instance_id}.jpg"
        if surface.uv is not None and picture.is_file():
            image = owned.block("images", keys[-1], partial(bpy.data.images.load, str(picture)))
            image.filepath = str(picture)
            image.reload()  # the file may be new under its old name
            mesh.materials.append(surface_material(owned, image=image, of=keys[-1]))
        else:
            mesh.materials.append(surface_material(owned))
        parent = child_collection(child_collection(root, "Meshes"), f"{kind.name} meshes")
        ob = owned.object(keys[-1], one.name, mesh, parent)
        name_object(ob, one.name)
        ob.color = object_colour(one.colour)
        ob["class"], ob["class_id"], ob["instance_id"] = kind.name, class_id, instance_id
        yield
    if (found := placed.find()) is not None:
        owned = OwnedDataBlocks(found[0][LIFT], found[1])
        owned.keep_known(lambda key: key in keys)
        owned.sweep_only("mesh:")
    return len(keys)


def are_stale(root: bpy.types.Collection) -> bool:
    """Whether corrections have changed more than names since a lift's meshes were made."""
    return text_of(root, _OF_MESHES) != text_of(root, CORRECTIONS)


def _fill(owned: OwnedDataBlocks, key: str, name: str, part: LabelledSurface) -> bpy.types.Mesh:
    """Fill our mesh `key` with smooth triangles, and Col, class_id and instance_id at its vertices; return it."""
    mesh: bpy.types.Mesh = owned.data(key, lambda: bpy.data.meshes.new(name))
    mesh.clear_geometry()
    set_faces(mesh, part.xyz, part.triangles)
    mesh.polygons.foreach_set("use_smooth", np.ones(len(part.triangles), bool))
    rgba = np.full((len(part.rgb), 4), 255, np.uint8)
    rgba[:, :3] = part.rgb
    mesh.color_attributes.new("Col", "BYTE_COLOR", "POINT")
    ids = {name: ("INT", getattr(part, name)) for name in ("class_id", "instance_id")}
    set_attributes(mesh, {"Col": ("BYTE_COLOR", rgba / np.float32(255)), **ids})  # a plain 255 would give float64
    mesh.color_attributes.active_color = mesh.color_attributes["Col"]
    if part.uv is not None:
        mesh.uv_layers.new(name="UVMap").uv.foreach_set("vector", np.ascontiguousarray(part.uv).ravel())
    mesh.materials.clear()
    mesh.update()
    mesh.validate()
    forget_selection(mesh)
    return mesh
