"""Export the lifted scene as meshes: rendered depth is fused into one surface, and cut into one mesh for each instance
and stuff class. One truncated signed distance field collects all views (`fusion`). Each view then votes on the labels
of the vertices that it sees. `mending` closes small holes, removes pieces far from their object, and cuts along the
lines where labels change. The meshes are written as binary glTF 2.0 by our own writer, as open3d's leaves the buffer
out."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..job import write_atomically
from ..job.prediction import mesh_bytes
from ..job.progress import Progress, unwatched
from ..job.system import main_memory
from ..passes.layers import linear
from ..passes.ply import columns_of, write_ply_table
from ..passes.previews import colour_picture
from ..posed.names import matte_names
from ..posed.ply import LEAST_TRIANGLES, rows_by_label
from ..scene import ClassTable, watched
from .fusion import SmallView, Surface, fuse
from .mending import (
    HAND,
    KEYS,
    close_holes,
    cut_by_label,
    even_labels,
    numbered,
    without_crumbs,
    without_flakes,
    without_fringe,
)  # fmt: skip
from .source import FinishedLift
from .texture import Texture, jpeg_bytes, textured


@dataclass(frozen=True, eq=False)
class Part:
    """The mesh of one instance, or of one stuff class (``instance_id`` 0), with a unique ``name``. ``xyz`` float32 [V,
    3] metres, z up; ``normal`` float32 [V, 3]; ``rgb`` uint8 [V, 3]; ``triangles`` int64 [T, 3]. ``uv`` float32 [T, 3,
    2] are their corners' positions in a ``picture`` uint8 [H, W, 3], as in `Texture`."""

    name: str
    class_name: str
    class_id: int
    instance_id: int
    xyz: NDArray[np.float32]
    normal: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    triangles: NDArray[np.int64]
    uv: NDArray[np.float32] | None = None
    picture: NDArray[np.uint8] | None = None

    def with_seams(self) -> tuple[Part, NDArray[np.float32]]:
        """Return the textured mesh with one texture coordinate per vertex, float32 [V, 2]; seams have two vertices."""
        assert self.uv is not None
        corners = np.ascontiguousarray(self.uv.reshape(-1, 2), np.float32)
        number, at = numbered(self.triangles.reshape(-1), corners.view(np.int64).ravel(), len(self.xyz))
        triangles, uv = number.reshape(-1, 3), np.empty((len(at), 2), np.float32)
        uv[number] = corners
        return replace(self, xyz=self.xyz[at], normal=self.normal[at], rgb=self.rgb[at], triangles=triangles), uv


FLOAT, _WHOLE, VERTICES, _INDICES = 5126, 5125, 34962, 34963  # glTF's codes for float32, uint32, and kinds of buffers
_MAGIC, _JSON, _BIN = b"glTF", b"JSON", b"BIN\0"
GENERATOR = "PLGS for Blender"  # the generator named in each file


def glb_bytes(parts: Sequence[Part]) -> bytes:
    """A GLB file with a node and a mesh for each part, in glTF's axes (y up). A node's ``extras`` hold its class and
    ids. Parts without pictures have vertex colours; the others do not, as glTF would multiply them with the picture."""
    buffer = GlbBuffer()
    nodes: list[dict[str, Any]] = []
    meshes: list[dict[str, Any]] = []
    matt = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    materials: list[dict[str, Any]] = [{"name": "vertex colours", "pbrMetallicRoughness": matt, "doubleSided": True}]
    images: list[dict[str, Any]] = []
    for part in parts:
        colours, values, number = "COLOR_0", linear(part.rgb / 255), 0
        if part.picture is not None:
            encoded = jpeg_bytes(part.picture)
            (part, values), colours, number = part.with_seams(), "TEXCOORD_0", len(materials)
            shown = matt | {"baseColorTexture": {"index": len(images)}}
            materials.append({"name": part.name, "pbrMetallicRoughness": shown, "doubleSided": True})
            images.append({"bufferView": buffer.add(encoded + b"\0" * (-len(encoded) % 4)), "mimeType": "image/jpeg"})
            buffer.views[-1]["byteLength"] = len(encoded)  # without the padding, by which glTF aligns what follows
        arrays = {"POSITION": upright(part.xyz), "NORMAL": upright(part.normal), colours: values}
        attributes = buffer.add_vertices(arrays)
        indices = buffer.add_array(part.triangles.reshape(-1), _WHOLE, "<u4", _INDICES)
        labels = {"class": part.class_name, "class_id": part.class_id, "instance_id": part.instance_id}
        nodes.append({"name": part.name, "mesh": len(meshes), "extras": labels})
        drawn = {"attributes": attributes, "indices": indices, "material": number}
        meshes.append({"name": part.name, "primitives": [drawn]})
    drawn_with: dict[str, Any] = {"materials": materials}
    if images:
        drawn_with |= {"images": images, "textures": [{"source": each} for each in range(len(images))]}
    return buffer.file(nodes, meshes, drawn_with)


class GlbBuffer:
    """The binary buffer of a GLB file, with its ``views`` and accessors."""

    def __init__(self) -> None:
        self.views, self._accessors, self._body = list[dict[str, int]](), list[dict[str, Any]](), bytearray()

    def add(self, data: bytes) -> int:
        """Append bytes and return the index of their buffer view."""
        self.views.append({"buffer": 0, "byteOffset": len(self._body), "byteLength": len(data)})
        self._body += data
        return len(self.views) - 1

    def add_array(self, values: NDArray[Any], code: int, dtype: str, target: int) -> int:
        """Append an array [N] or [N, K] and return the index of its accessor. ``dtype`` is NumPy's name of its type;
        ``code`` and ``target`` are glTF's codes for type and use."""
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        view = self.add(np.ascontiguousarray(values, dtype).tobytes())
        self.views[view]["target"] = target
        self._accessors.append({"bufferView": view, "componentType": code, "count": len(values), "type": kind})
        return len(self._accessors) - 1

    def add_vertices(self, arrays: Mapping[str, NDArray[Any]]) -> dict[str, int]:
        """Append vertex attributes by glTF's names, float32 [N] or [N, K]. Returns their accessors' indices by name.
        POSITION's accessor also gets the smallest and largest coordinates."""
        found = {name: self.add_array(values, FLOAT, "<f4", VERTICES) for name, values in arrays.items()}
        xyz = arrays["POSITION"]
        limits = {"min": xyz.min(axis=0).tolist(), "max": xyz.max(axis=0).tolist()}
        self._accessors[found["POSITION"]] |= limits
        return found

    def file(self, nodes: Sequence[Any], meshes: Sequence[Any], more: Mapping[str, Any]) -> bytes:
        """A GLB file of one scene with these nodes and meshes, the keys ``more`` in glTF's JSON, and this buffer."""
        about = {"asset": {"version": "2.0", "generator": GENERATOR}, "scene": 0}
        shown = {"scenes": [{"nodes": list(range(len(nodes)))}], "nodes": nodes, "meshes": meshes}
        own = {"buffers": [{"byteLength": len(self._body)}], "bufferViews": self.views, "accessors": self._accessors}
        head = json.dumps(about | shown | dict(more) | own, ensure_ascii=False).encode()
        chunks = _chunk(_JSON, head, b" ") + _chunk(_BIN, bytes(self._body), b"\0")
        return struct.pack("<4sII", _MAGIC, 2, 12 + len(chunks)) + chunks  # version 2, after a header of 12 bytes


def upright(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Rotate positions or directions [N, 3] from z up to glTF's y up."""
    return np.ascontiguousarray(values[:, (0, 2, 1)] * np.array([1, 1, -1], np.float32), "<f4")


def _chunk(kind: bytes, content: bytes, padding: bytes) -> bytes:
    content += padding * (-len(content) % 4)
    return struct.pack("<I4s", len(content), kind) + content


LEAST_ALPHA = 0.7  # alpha below which a pixel's depth is not a surface
WIDEST, MOST_VIEWS = 480, 80  # maximum width in pixels, and number, of the views that are fused
_AROUND, _OFF, _OFF_SHARE = 7, 0.1, 0.04
"""The side in pixels of the square around a pixel whose depths are compared with the measured one, and by how many
metres, or what share, the latter may lie outside their range."""
SEEN_WITHIN = 0.05  # a view votes on a vertex if its depth there differs by at most this many metres
LONGEST, MOST_BYTES = 60, 180  # maximum characters and bytes of a name in a file name
MOST_INSTANCES = 1 << 16  # factor of the class in a label, which is class * this + instance


def export_mesh(lift: FinishedLift, output: Path) -> None:
    """Write mesh.ply, the whole surface with class_id and instance_id of every vertex, and meshes/<name>.glb, one per
    instance and stuff class (glTF's axes, y up). Raises PlgsError if no surface was rendered, OSError."""
    surface, label, texture = finished(lift)
    write_surface(lift, output / "mesh.ply", surface, label)
    for part in watched(_cut(lift, surface, label, texture), lift.part(TEXTURED, 1.0)):
        write_atomically(output / "meshes" / f"{part.name}.glb", glb_bytes([part]))
    lift.progress(1, 1)


def write_surface(
    lift: FinishedLift, path: Path, surface: Surface, label: NDArray[np.int64], texture: Texture | None = None
) -> None:
    """Write a surface and its labels [V] as PLY, and its texture as pictures/CLASS_INSTANCE.jpg. Raises OSError."""
    class_id, instance_id = np.divmod(label, MOST_INSTANCES)
    columns = {
        **columns_of("x y z", surface.xyz),
        **columns_of("nx ny nz", surface.normal),
        **columns_of("red green blue", surface.rgb),
        **{"class_id": class_id.astype(np.int32), "instance_id": instance_id.astype(np.int32)},
    }
    fingerprint = lift.corrected.label_fingerprint
    comment = f"corrections {fingerprint}" if fingerprint else ""
    for value, picture in (texture.pictures if texture is not None else {}).items():
        name = "{}_{}.jpg".format(*divmod(value, MOST_INSTANCES))
        write_atomically(path.parent / "pictures" / name, jpeg_bytes(picture))
    uv = None if texture is None else texture.uv * np.array([1, -1], np.float32) + np.array([0, 1], np.float32)
    write_ply_table(path, columns, surface.triangles, comment, uv)


def export_gltf(lift: FinishedLift, output: Path) -> None:
    """Write lift.glb: the meshes of wanted objects and stuff, by name. Raises PlgsError without a surface, OSError."""
    write_atomically(output / "lift.glb", glb_bytes(watched(parts_of(lift), lift.part(TEXTURED, 1.0))))
    lift.progress(1, 1)


def parts_of(lift: FinishedLift) -> list[Part]:
    """Return the meshes of the wanted instances and stuff classes. Raises PlgsError if there are none, OSError."""
    parts = _cut(lift, *finished(lift))
    parts = [each for each in parts if lift.wants(each.class_id, each.instance_id)]
    if not parts:
        what = "no rendered view shows the surface of these objects"
        raise PlgsError("no-such-surface", what, lift.folder.path, "Export more frames.")
    return parts


def _cut(lift: FinishedLift, surface: Surface, label: NDArray[np.int64], texture: Texture | None) -> list[Part]:
    """Cut a labelled surface into one mesh for each label, with its picture. Pieces too small to keep are left out."""
    names, parts = label_names(np.unique(label), lift.classes, lift.instances.names), []
    for value, rows in rows_by_label(surface.triangles, label).items():
        if value in names and len(rows) >= LEAST_TRIANGLES:
            (part, _), (class_id, instance_id) = surface.of(surface.triangles[rows]), divmod(value, MOST_INSTANCES)
            shape = (part.xyz, part.normal, part.rgb, part.triangles)
            drawn = (None, None) if texture is None else (texture.uv[rows], texture.pictures[value])
            parts.append(Part(names[value], lift.classes[class_id].name, class_id, instance_id, *shape, *drawn))
    return parts


DRAWN, FUSED, LABELLED, MENDED, TEXTURED = 0.35, 0.5, 0.55, 0.65, 0.9
"""Shares of an export of meshes after its views are drawn and fused, and its surface is labelled, mended, textured."""


def finished(lift: FinishedLift) -> tuple[Surface, NDArray[np.int64], Texture | None]:
    """Return the surface, mended and cut, labels int64 [V], texture (None: no photos). Raises PlgsError if empty."""
    small = views_of(lift, WIDEST, MOST_VIEWS, lift.part(0.0, DRAWN))
    surface = fuse(small, progress=lift.part(DRAWN, FUSED))
    refuse_none(lift, surface)
    label = vertex_labels(surface.xyz, watched(small, lift.part(FUSED, LABELLED)))
    mending = lift.part(LABELLED, MENDED)
    surface, label = cut_by_label(*mended(*without_flakes(surface, label), progress=mending))
    mending(1, 1)
    refuse_none(lift, surface)
    texture = textured(surface, label, small, lift.part(MENDED, TEXTURED)) if lift.has_photos else None
    return surface, label, texture


def refuse_none(lift: FinishedLift, surface: Surface) -> None:
    """Raise PlgsError for a surface without triangles."""
    if not len(surface.triangles):
        fix = "Export more frames, or lift the scene with better depth."
        raise PlgsError("no-surface", "the rendered views show no surface", lift.folder.path, fix)


def mended(
    surface: Surface, label: NDArray[np.int64], largest: float = HAND, progress: Progress = unwatched
) -> tuple[Surface, NDArray[np.int64]]:
    """The surface and its labels [V] with holes up to ``largest`` metres closed, and without loose and tiny pieces."""
    progress(0, 5)
    surface, label = close_holes(surface, label, largest)
    progress(1, 5)
    surface, label = without_fringe(surface, label)
    progress(2, 5)
    label = even_labels(surface.triangles, label)
    progress(3, 5)
    label = without_crumbs(surface, label, label % MOST_INSTANCES == 0)
    progress(4, 5)
    return surface, label


def views_of(lift: FinishedLift, width: int, most: int, progress: Progress = unwatched) -> list[SmallView]:
    """Return at most ``most`` of the lift's views, ``width`` pixels wide. Raises PlgsError or OSError for bad files."""
    expect_memory(lift, width, most)
    views = []
    for frame, camera, layers in lift.small_views(width, most, progress):
        depth = np.where(layers.combined[..., 3] >= LEAST_ALPHA, layers.depth, 0).astype(np.float32)
        if lift.has_photos and frame.read_depth is not None:
            depth = sharpened(depth, frame.read_depth(camera.size))
        label = layers.semantic.astype(np.int64) * MOST_INSTANCES + layers.instance
        views.append(SmallView(camera, depth, colour_picture(layers), label, frame))
    return views


def expect_memory(lift: FinishedLift, width: int, most: int) -> None:
    """Warn if ``most`` views of this width are likely to need more memory than is free."""
    memory, sizes = main_memory(), [frame.size for frame in lift.frames] or [(1, 1)]
    height = round(max(high * width / max(wide, width) for wide, high in sizes))
    needed = mesh_bytes(min(most, len(lift.frames)), (width, height))
    if memory is not None and needed > memory.free and lift.warn is not None:
        lift.warn(
            f"The export needs about {needed / 1e9:.1f} GB of memory, but only {memory.free / 1e9:.1f} GB is free."
        )


def sharpened(depth: NDArray[np.float32], measured: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a rendered depth [H, W] in metres, with measured values wherever these lie within the range of the
    rendered depths around. Rendered depth is blurred at outlines, and measured depth may be wrong."""
    around = np.ones((_AROUND, _AROUND), np.uint8)
    nearest = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), around)  # 0 means none, not near
    off = np.maximum(_OFF, _OFF_SHARE * measured)
    is_known = (measured > 0) & (measured > nearest - off) & (measured < cv2.dilate(depth, around) + off)
    return np.where(is_known, measured, depth).astype(np.float32)


def vertex_labels(xyz: NDArray[np.float32], views: Sequence[SmallView], times: int = 1) -> NDArray[np.int64]:
    """Return the label that most views show at each vertex, int64 [V]; 0 for none. A view counts if its depth, enlarged
    ``times`` times, agrees with the vertex."""
    votes = []
    for view in views:
        vertex, pixel, depth = view.camera.seen(xyz)
        column, row = pixel.astype(np.int64).T
        x, y = (times * pixel).astype(np.int64).T
        seen = np.abs(view.large_depth(times)[y, x] - depth) < SEEN_WITHIN
        votes.append(vertex[seen] * KEYS + view.label[row[seen], column[seen]])
    pairs, count = np.unique(np.concatenate(votes), return_counts=True)
    found, order = np.zeros(len(xyz), np.int64), np.argsort(count[::-1], kind="stable")
    vertex, label = np.divmod(pairs[::-1][order], KEYS)
    found[vertex] = label  # the most frequent is written last, and of several the lowest
    return found


def label_names(labels: NDArray[np.int64], classes: ClassTable, instances: Mapping[int, str]) -> dict[int, str]:
    """Return a file name for each label: the instance's name or, for stuff, the class's. Void gets no name."""
    names = {}
    for value in labels.tolist():
        class_id, instance = divmod(value, MOST_INSTANCES)
        if class_id in classes:
            names[value] = instances.get(instance, f"instance {instance}") if instance else classes[class_id].name
    safe = {value: "".join("-" if c in "<>:/|?*" else c for c in name[:LONGEST]) for value, name in names.items()}
    return matte_names({value: name.encode()[:MOST_BYTES].decode(errors="ignore") for value, name in safe.items()})
