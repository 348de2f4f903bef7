"""Binary glTF 2.0 of one coloured triangle mesh. (open3d's own writer leaves the buffer out.)"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FLOAT, _WHOLE, _VERTICES, _INDICES = 5126, 5125, 34962, 34963
"""glTF's codes for float32, uint32, and what buffers hold."""
_MAGIC, _JSON, _BIN = b"glTF", b"JSON", b"BIN\0"


def glb_bytes(
    name: str,
    xyz: NDArray[np.float32],
    normal: NDArray[np.float32],
    linear: NDArray[np.float32],
    triangles: NDArray[np.integer],
) -> bytes:
    """``xyz`` [V, 3] metres in glTF's axes (y up), ``normal`` [V, 3], ``linear`` colours [V, 3] in 0..1, ``triangles``
    [T, 3]."""
    arrays: list[tuple[NDArray[Any], int, str, int]] = [
        (np.ascontiguousarray(xyz, "<f4"), _FLOAT, "VEC3", _VERTICES),
        (np.ascontiguousarray(normal, "<f4"), _FLOAT, "VEC3", _VERTICES),
        (np.ascontiguousarray(linear, "<f4"), _FLOAT, "VEC3", _VERTICES),
        (np.ascontiguousarray(triangles.reshape(-1), "<u4"), _WHOLE, "SCALAR", _INDICES),
    ]
    views, accessors, body = [], [], b""
    for number, (values, kind, shape, target) in enumerate(arrays):
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": values.nbytes, "target": target})
        accessors.append({"bufferView": number, "componentType": kind, "count": len(values), "type": shape})
        body += values.tobytes()
    accessors[0] |= {"min": xyz.min(axis=0).tolist(), "max": xyz.max(axis=0).tolist()}  # required for positions
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    content = {
        "asset": {"version": "2.0", "generator": "PLGS for Blender"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0}],
        "meshes": [{"name": name, "primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    head = json.dumps(content, ensure_ascii=False).encode()
    chunks = _chunk(_JSON, head, b" ") + _chunk(_BIN, body, b"\0")
    return struct.pack("<4sII", _MAGIC, 2, 12 + len(chunks)) + chunks


def _chunk(kind: bytes, content: bytes, padding: bytes) -> bytes:
    content += padding * (-len(content) % 4)
    return struct.pack("<I4s", len(content), kind) + content
