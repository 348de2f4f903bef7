"""Binary glTF 2.0 of coloured triangle meshes, each with its name. (open3d's own writer leaves the buffer out.)"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..passes.layers import linear
from .parts import Part

_FLOAT, _WHOLE, _VERTICES, _INDICES = 5126, 5125, 34962, 34963
"""glTF's codes for float32, uint32, and what buffers hold."""
_MAGIC, _JSON, _BIN = b"glTF", b"JSON", b"BIN\0"


GENERATOR = "PLGS for Blender"
"""What each file says of its maker, in its first 128 bytes."""


def glb_bytes(parts: Sequence[Part]) -> bytes:
    """A node and a mesh for each part, in glTF's axes (y up). A node's ``extras`` have its class and its ids."""
    views: list[dict[str, int]] = []
    accessors: list[dict[str, Any]] = []
    nodes: list[dict[str, Any]] = []
    meshes: list[dict[str, Any]] = []
    body = bytearray()
    for part in parts:
        xyz = _upright(part.xyz)
        arrays: list[tuple[NDArray[Any], int, str, int]] = [
            (xyz, _FLOAT, "VEC3", _VERTICES),
            (_upright(part.normal), _FLOAT, "VEC3", _VERTICES),
            (np.ascontiguousarray(linear(part.rgb / 255), "<f4"), _FLOAT, "VEC3", _VERTICES),
            (np.ascontiguousarray(part.triangles.reshape(-1), "<u4"), _WHOLE, "SCALAR", _INDICES),
        ]
        first = len(accessors)
        for values, kind, shape, target in arrays:
            accessors.append({"bufferView": len(views), "componentType": kind, "count": len(values), "type": shape})
            views.append({"buffer": 0, "byteOffset": len(body), "byteLength": values.nbytes, "target": target})
            body += values.tobytes()
        accessors[first] |= {"min": xyz.min(axis=0).tolist(), "max": xyz.max(axis=0).tolist()}  # required for positions
        attributes = {"POSITION": first, "NORMAL": first + 1, "COLOR_0": first + 2}
        labels = {"class": part.class_name, "class_id": part.class_id, "instance_id": part.instance_id}
        nodes.append({"name": part.name, "mesh": len(meshes), "extras": labels})
        drawn = {"attributes": attributes, "indices": first + 3, "material": 0}
        meshes.append({"name": part.name, "primitives": [drawn]})
    content = {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    head = json.dumps(content, ensure_ascii=False).encode()
    chunks = _chunk(_JSON, head, b" ") + _chunk(_BIN, bytes(body), b"\0")
    return struct.pack("<4sII", _MAGIC, 2, 12 + len(chunks)) + chunks


def _upright(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """From z up to glTF's y up."""
    return np.ascontiguousarray(values[:, (0, 2, 1)] * np.array([1, 1, -1], np.float32), "<f4")


def _chunk(kind: bytes, content: bytes, padding: bytes) -> bytes:
    content += padding * (-len(content) % 4)
    return struct.pack("<I4s", len(content), kind) + content
