"""Coloured points from a PLY file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.counts import check_count
from ...posed.layout import read_file
from ..frame import SparsePoints

_MOST_BYTES = 1 << 30
_MOST_IN_TEXT = 1_000_000
"""The largest number of vertices as text: as many take some seconds."""
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"), **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"), **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"), **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"), **dict.fromkeys(("double", "float64"), "f8"),
}  # fmt: skip
_VERTEX_IN_MEMORY, _VALUE_IN_MEMORY = 48, 200
"""Bytes of a vertex with its colour, and of a number in a line of text with its text."""
_SHORT = "Write this file again."
_FIX = "Write a PLY whose first element is vertex, with x, y, z."


def read_ply_points(path: Path) -> SparsePoints:
    """The vertices of a PLY (ascii or binary), white if it has no colours. Raises PlgsError."""
    data = read_file(path, _MOST_BYTES)
    end = data.find(b"end_header")
    body = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or not body:
        raise PlgsError("this is not a PLY file", path, _FIX)
    form, count, fields = _parse_header(data[:end].decode("ascii", "replace"), path)
    vertices = _vertices(data[body:], form, count, np.dtype(fields), path)
    names = vertices.dtype.names or ()
    xyz = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    rgb = np.full((count, 3), 255, np.uint8)
    if {"red", "green", "blue"} <= {*names}:
        rgb = np.stack([vertices[name].astype(np.uint8) for name in ("red", "green", "blue")], axis=-1)
    good = np.isfinite(xyz).all(-1)
    return SparsePoints(xyz[good], rgb[good])


def _parse_header(header: str, path: Path) -> tuple[str, int, list[tuple[str, str]]]:
    """The format's name, the number of vertices and their fields. Raises PlgsError."""
    lines = [line.split() for line in header.splitlines()]
    form = next((line[1] for line in lines if len(line) > 1 and line[0] == "format"), "")
    elements = [i for i, line in enumerate(lines) if line[:1] == ["element"]]
    vertex = lines[elements[0]] if elements else []
    if len(vertex) != 3 or vertex[1] != "vertex" or not vertex[2].isdecimal():
        raise PlgsError("the PLY does not begin with vertices", path, _FIX)
    last = elements[1] if len(elements) > 1 else len(lines)
    order = ">" if form == "binary_big_endian" else "<"
    fields = []
    for line in lines[elements[0] + 1 : last]:
        if line[:1] == ["property"]:
            if len(line) != 3 or line[1] not in _TYPES:
                raise PlgsError("the PLY's vertices have a property that is not understood", path, _FIX)
            fields.append((line[2], order + _TYPES[line[1]]))
    names = [name for name, _ in fields]
    if not {"x", "y", "z"} <= {*names} or len({*names}) < len(names):
        raise PlgsError("the PLY's vertices have no x, y and z", path, _FIX)
    return form, int(vertex[2]), fields


def _vertices(body: bytes, form: str, count: int, fields: np.dtype[np.void], path: Path) -> NDArray[np.void]:
    """The vertices, a structured array [count]. Raises PlgsError."""
    if form != "ascii":
        room = len(body) // fields.itemsize
        check_count(count, "vertices", path, _SHORT, most=_MOST_BYTES, room=room, made=_VERTEX_IN_MEMORY)
        return np.frombuffer(body, fields, count)
    values = len(fields.names or ())
    room = len(body) // (2 * values)  # a digit and what separates it from the next
    made = values * _VALUE_IN_MEMORY
    check_count(
        count, "vertices as text", path, "Write it as a whole, as binary.", most=_MOST_IN_TEXT, room=room, made=made
    )
    rows = [line.decode("ascii", "replace").split() for line in body.split(b"\n", count)[:count]]
    check_count(count, "vertices", path, _SHORT, most=count, room=len(rows), made=0)
    try:
        return np.array([tuple(float(value) for value in row) for row in rows], fields)
    except (ValueError, OverflowError) as error:
        raise PlgsError("the PLY's vertices are not numbers", path, _FIX) from error
