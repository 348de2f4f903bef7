"""The objects and the labelled points of a result: instances.json, semantic_points.npz, anchors.npz. They are written
and read only here, by the engine and by Blender. The same content gives the same bytes. Readers check all values in a
file."""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import PlgsError
from .gates import one_line, read_plain
from .job import write_atomically
from .job.manifest import MAKE_ANEW
from .json_file import MOST_BYTES, read_object
from .posed import Category, ClassTable
from .posed.array_file import read_npz
from .posed.classes import LARGEST_ID

INSTANCES, SEMANTIC_POINTS, ANCHORS = "instances.json", "semantic_points.npz", "anchors.npz"

_FORMAT = 1
_LARGEST = 2**31 - 1
"""The largest whole number that Blender can store."""
_FARTHEST = 1e6
"""Metres. No room is this large, and sums of numbers near the largest float would overflow."""
BAD = (OSError, KeyError, ValueError, TypeError, AttributeError, OverflowError, RecursionError)
"""The errors that are raised when content has the wrong form."""
_CORNER = r"[01]\.\d{3},[01]\.\d{3}"
_OUTLINE = re.compile(rf"{_CORNER}(?:[ ;]{_CORNER})*")
_ARRAYS: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
    "xyz": (np.float32, (3,)),
    "rgb": (np.uint8, (3,)),
    "class_id": (np.int32, ()),
    "instance_id": (np.int32, ()),
    "level": (np.int32, ()),
    "confidence": (np.float32, ()),
    "opacity": (np.float32, ()),
}
"""The type of each array, and the shape of a row."""


@dataclass(frozen=True, eq=False)
class SemanticPoints:
    """Labelled points: ``xyz`` float32 [N, 3] world metres, ``rgb`` uint8 [N, 3] sRGB, ``class_id`` int32 [N] (0 =
    unknown), ``instance_id`` int32 [N] (0 = none), ``confidence`` float32 [N], the class's probability."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    class_id: NDArray[np.int32]
    instance_id: NDArray[np.int32]
    confidence: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Anchors:
    """The model's anchors: ``xyz`` float32 [M, 3] world metres, ``class_id``, ``instance_id`` int32 [M], ``opacity``
    float32 [M] (mean of max(opacity, 0) of its Gaussians), ``level`` int32 [M] (0 initial, 1.. grown), ``rgb`` uint8
    [M, 3]."""

    xyz: NDArray[np.float32]
    class_id: NDArray[np.int32]
    instance_id: NDArray[np.int32]
    opacity: NDArray[np.float32]
    level: NDArray[np.int32]
    rgb: NDArray[np.uint8]


@dataclass(frozen=True)
class MatchedSegment:
    """A mask's segment that was matched to an instance, with its own class and score. ``cost`` and ``agreement`` say
    why it was matched; one of them is None. ``cost`` is that of Algorithm 1, from -1.5 (same box) to 0, and None for
    the segment that created the instance. ``agreement`` is the share of the views' judgements that join it with the
    instance's other masks. ``pixels`` is the number of its pixels with depth, at the size of the lift, and ``share``
    its share of the picture's pixels. ``rectangle`` is around it: left, top, right, bottom, 0..1. ``outline`` has
    polygons around its parts, "x,y x,y x,y;x,y x,y x,y" in fractions of the picture. The last five are None, 0 and
    empty in the first versions of this file."""

    frame: str
    segment_id: int
    class_id: int
    score: float
    cost: float | None
    agreement: float | None
    pixels: int
    share: float
    rectangle: tuple[float, float, float, float]
    outline: str = ""


@dataclass(frozen=True)
class Instance:
    """One object: ``centre`` and ``size`` of its box in world metres, ``yaw`` in radians about +z, ``rotation`` the
    same as a quaternion wxyz, ``colour`` sRGB bytes, ``score`` in [0, 1], ``points`` the number of points it owns,
    ``views`` the number of frames whose masks show it, in ``segments``."""

    id: int
    name: str
    class_id: int
    class_name: str
    colour: tuple[int, int, int]
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float
    rotation: tuple[float, float, float, float]
    views: int
    score: float
    points: int
    segments: tuple[MatchedSegment, ...]


Arrays = TypeVar("Arrays", SemanticPoints, Anchors)
Number = TypeVar("Number", int, float)
Listed = tuple[ClassTable, tuple[Instance, ...]]


def write_arrays(path: Path, arrays: SemanticPoints | Anchors, *, fast: bool = False) -> None:
    """Write an .npz whose bytes depend only on the arrays. ``fast`` makes it about a tenth larger. Raises ValueError if
    lengths differ, and OSError."""
    named = {name: np.ascontiguousarray(array, _ARRAYS[name][0]) for name, array in vars(arrays).items()}
    if len({len(array) for array in named.values()}) != 1:
        lengths = ", ".join(f"{name} {len(array)}" for name, array in named.items())
        raise ValueError(f"arrays differ in length: {lengths}")
    write_atomically(path, npz_bytes(named, fast=fast))


def npz_bytes(arrays: Mapping[str, NDArray[Any]], *, fast: bool = False) -> bytes:
    """Return an .npz of these arrays, whose bytes depend only on them. ``fast`` makes it about a tenth larger."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")  # dated 1980-01-01
            # Of positions, compression takes nine tenths of its time and saves a tenth.
            entry.compress_type = zipfile.ZIP_STORED if fast and name == "xyz" else zipfile.ZIP_DEFLATED
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, array, allow_pickle=False)
            archive.writestr(entry, buffer.getbuffer(), compresslevel=1 if fast else 6)
    return content.getvalue()


def read_arrays(path: Path, kind: type[Arrays]) -> Arrays:
    """Read the arrays of a file. Raises PlgsError unless all have the right types and the same number of rows."""
    try:
        arrays = read_npz(path, MAKE_ANEW, [field.name for field in fields(kind)])
    except PlgsError as error:
        raise PlgsError(error.key, error.what, path, MAKE_ANEW) from error
    rows: tuple[int, ...] = arrays["xyz"].shape[:1]
    for name, array in arrays.items():
        dtype, tail = _ARRAYS[name]
        if array.shape != rows + tail or array.dtype != dtype:
            raise PlgsError("shape", f"cannot be read ({name} is {array.dtype} {list(array.shape)})", path, MAKE_ANEW)
    if not (np.abs(arrays["xyz"]) <= _FARTHEST).all():  # false for NaN, too
        raise PlgsError("positions", "holds positions that are not numbers or are impossibly far away", path, MAKE_ANEW)
    return kind(**arrays)


def write_instances(path: Path, classes: ClassTable, instances: Sequence[Instance]) -> None:
    """Write instances in ascending order of id. Raises ValueError for NaN or a repeated id, OSError."""
    ids = [instance.id for instance in instances]
    if len(set(ids)) != len(ids) or min(ids, default=1) < 1:
        raise ValueError("instance ids must be unique and at least 1")
    content = {
        "format": _FORMAT,
        "up": "z",
        "classes": [asdict(category) for category in classes.categories],
        "instances": [asdict(instance) for instance in sorted(instances, key=lambda instance: instance.id)],
    }
    write_atomically(path, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_instances(path: Path, content: Any = None) -> Listed:
    """The classes and instances of a file, or of its ``content`` if read before. Raises PlgsError for a bad file."""
    content = content or read_object(path, MAKE_ANEW)
    try:
        if content["format"] != _FORMAT:
            fix = "Use the version of PLGS that wrote it, or lift into another folder."
            what = f"has format {content['format']!r}, but this version reads {_FORMAT}"
            raise PlgsError("other-format", what, path, fix)
        categories = [
            Category(_id(each["id"]), _text(each["name"]), bool(each["is_thing"]), _colour(each["colour"]))
            for each in content["classes"]
        ]
        instances = tuple(each if isinstance(each, Instance) else instance_of(each) for each in content["instances"])
        for kind, rows in (("class", categories), ("instance", instances)):
            if len({row.id for row in rows}) < len(rows):
                raise ValueError(f"two {kind} ids are equal")
        return ClassTable(tuple(sorted(categories, key=lambda category: category.id))), instances
    except BAD as error:
        raise PlgsError("instances-damaged", f"cannot be read ({error!r})", path, MAKE_ANEW) from error


def instances_text(path: Path) -> str:
    """Read the text of a file, to be parsed in parts. Raises OSError, ValueError."""
    return read_plain(path, MOST_BYTES).decode("utf-8-sig")


def instance_of(entry: dict[str, Any]) -> Instance:
    """Return the instance of an element of the file's list. Raises one of the errors ``BAD`` if its form is wrong."""
    return Instance(
        id=_id(entry["id"], least=1),
        name=_text(entry["name"]),
        class_id=_id(entry["class_id"]),
        class_name=_text(entry["class_name"]),
        colour=_colour(entry["colour"]),
        centre=_floats(entry["centre"], 3),
        size=_floats(entry["size"], 3),
        yaw=_number(entry["yaw"]),
        rotation=_floats(entry["rotation"], 4),
        views=_whole(entry["views"]),
        score=_number(entry["score"]),
        points=_whole(entry["points"]),
        segments=tuple(_segment(each) for each in entry.get("segments", ())),
    )


def _segment(entry: dict[str, Any]) -> MatchedSegment:
    cost, agreement = entry.get("cost"), entry.get("agreement")
    return MatchedSegment(
        frame=_text(entry["frame"]),
        segment_id=_whole(entry["segment_id"]),
        class_id=_id(entry["class_id"]),
        score=_number(entry["score"]),
        cost=None if cost is None else _number(cost),
        agreement=None if agreement is None else _number(agreement),
        pixels=_whole(entry.get("pixels", 0)),
        share=_number(entry.get("share", 0.0)),
        rectangle=_floats(entry.get("rectangle", (0.0, 0.0, 0.0, 0.0)), 4),
        outline=_outline(entry.get("outline", "")),
    )


def _outline(value: Any) -> str:
    if not isinstance(value, str) or (value and not _OUTLINE.fullmatch(value)):
        raise ValueError(f"{value!r} is not an outline")
    return value


def _colour(value: Any) -> tuple[int, int, int]:
    red, green, blue = (_within(int(part), 0, 255) for part in value)
    return red, green, blue


def _whole(value: Any) -> int:
    return _within(int(value), 0, _LARGEST)


def _id(value: Any, least: int = 0) -> int:
    """Return ``value`` as an id from ``least`` to a limit, as palettes and lists have entries for all smaller ids."""
    return _within(int(value), least, LARGEST_ID)


def _within(number: Number, least: Number, most: Number) -> Number:
    if not least <= number <= most:  # true for NaN, too
        raise ValueError(f"{number!r} is not between {least} and {most}")
    return number


def _text(value: Any) -> str:
    text = str(value)
    text.encode()  # half of a surrogate pair is not text; UnicodeEncodeError is a ValueError
    return one_line(text)


def _number(value: Any) -> float:
    return _within(float(value), -_FARTHEST, _FARTHEST)


def _floats(value: Any, count: int) -> Any:
    numbers = tuple(map(_number, value))
    if len(numbers) != count:
        raise ValueError(f"{value!r} is not {count} numbers")
    return numbers
