"""Reading a finished lift folder. Plain numpy and JSON; says what is wrong with a folder instead of
guessing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..engine.job import JobError, LiftFolder, ResultFile, check_sizes
from ..engine.job.json_file import read_object
from ..engine.job.manifest import MAKE_ANEW, verify_files
from ..engine.scene import Category, ClassTable, Scene, SceneError, open_asked
from ..engine.scene.array_file import read_npz
from ..engine.scene.classes import LARGEST_ID

_FORMAT = 1
_LARGEST = 2**31 - 1
"""Of the integers that Blender keeps."""
_FARTHEST = 1e6
"""Metres. No room is that large; numbers near the largest float would spoil the sums that are made of them."""
_READ = ("semantic_points.npz", "anchors.npz", "instances.json")
_MOST_HASHED = 1 << 30
"""Bytes: half a second, as a rule."""
_BAD = (OSError, KeyError, ValueError, TypeError, AttributeError, OverflowError, RecursionError)
"""What reading content of the wrong form raises."""


@dataclass(frozen=True, eq=False)
class SemanticPoints:
    """xyz float32 [N, 3] metres, rgb uint8 [N, 3] sRGB, class_id and instance_id int32 [N], confidence
    float32 [N] 0..1.
    """

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    class_id: NDArray[np.int32]
    instance_id: NDArray[np.int32]
    confidence: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Anchors:
    """xyz float32 [M, 3] metres, rgb uint8 [M, 3] sRGB, class_id, instance_id, level int32 [M], opacity
    float32 [M].
    """

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    class_id: NDArray[np.int32]
    instance_id: NDArray[np.int32]
    opacity: NDArray[np.float32]
    level: NDArray[np.int32]


@dataclass(frozen=True)
class Mask:
    """A mask's segment that was matched to an instance, with the class and score it has itself. `share` of the
    picture's pixels and `rectangle` (left, top, right, bottom, 0..1) tell where it lies, `pixels` how many it has
    with depth. Why it was matched: `cost` of the match by boxes, or the view `agreement` (0..1). Lifts of older
    versions have no more than `cost`: then the rest is zero and None.
    """

    frame: str
    segment_id: int
    class_id: int
    score: float
    cost: float | None
    agreement: float | None
    pixels: int
    share: float
    rectangle: tuple[float, float, float, float]


@dataclass(frozen=True)
class Instance:
    """One object: its box (centre and size in metres, rotation w x y z), sRGB colour, and what speaks for
    it.
    """

    id: int
    name: str
    class_id: int
    class_name: str
    colour: tuple[int, int, int]
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    views: int
    score: float
    points: int
    masks: tuple[Mask, ...]


@dataclass(frozen=True, eq=False)
class LiftResult:
    """A finished lift: the frames it was made from and what came out. `passes` are the EXR files by frame name,
    `shots` those that were baked from other cameras, by their names.
    """

    folder: Path
    scene: Scene
    classes: ClassTable
    instances: tuple[Instance, ...]
    points: SemanticPoints
    anchors: Anchors
    passes: dict[str, Path]
    shots: dict[str, Path] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The scene's folder name: what people call it."""
        return self.scene.folder.name


def read_result(folder: Path) -> LiftResult:
    """Read the result of a finished lift and open its scene (headers only).

    Raises JobError when the folder is no lift, is not finished, or was damaged; SceneError when the scene it
    was lifted from is no longer there or no longer whole.
    """
    lift = LiftFolder.open(folder)
    lift.refuse_foreign()
    listed = {str(file.path): file for file in check_sizes(lift.result_path).files}
    asked = lift.request
    scene = open_asked(asked)
    exrs = _listed_passes(lift, listed)
    _verify(lift, [*_READ, *(path.relative_to(lift.result_path).as_posix() for path in exrs)], listed)
    classes, instances = _read_instances(lift.result_path / "instances.json")
    by_name = {path.stem: path for path in exrs}
    passes = {frame.name: by_name[frame.name] for frame in scene.frames if frame.name in by_name}
    return LiftResult(
        folder=lift.path,
        scene=scene,
        classes=classes,
        instances=instances,
        points=_read_arrays(lift.result_path / "semantic_points.npz", SemanticPoints),
        anchors=_read_arrays(lift.result_path / "anchors.npz", Anchors),
        passes=passes,
        shots={path.stem: path for path in exrs if path.stem not in passes},
    )


def _verify(lift: LiftFolder, paths: Iterable[str], listed: Mapping[str, ResultFile]) -> None:
    """Compare what Blender opens with the manifest's checksums, before anything is changed. Raises JobError.

    So the rot of a disk is told, not placed. Of very many passes the first gigabyte: the window waits meanwhile.
    """
    files, size = [], 0
    for path in paths:
        if path not in listed:
            raise JobError("is not listed", lift.manifest_path, MAKE_ANEW)
        size += listed[path].bytes
        if size > _MOST_HASHED and path not in _READ:
            break
        files.append(listed[path])
    verify_files(lift.result_path, files)


def _listed_passes(lift: LiftFolder, listed: Iterable[str]) -> list[Path]:
    """The EXR files that the manifest lists, by name."""
    paths = (lift.result_path / path for path in listed)
    return sorted(path for path in paths if path.parent == lift.passes_path and path.suffix == ".exr")


_ARRAYS = {
    "xyz": (np.float32, (3,)),
    "rgb": (np.uint8, (3,)),
    "class_id": (np.int32, ()),
    "instance_id": (np.int32, ()),
    "level": (np.int32, ()),
    "confidence": (np.float32, ()),
    "opacity": (np.float32, ()),
}


def _read_arrays(path: Path, kind: Any) -> Any:
    """Fill a dataclass of arrays from an .npz file, each with the right type and as many rows as the
    first.
    """
    try:
        arrays = read_npz(path, MAKE_ANEW, list(kind.__dataclass_fields__))
    except SceneError as error:
        raise JobError(error.what, path, MAKE_ANEW) from error
    rows = arrays["xyz"].shape[:1]
    for name, array in arrays.items():
        dtype, tail = _ARRAYS[name]
        if array.shape != (*rows, *tail) or array.dtype != dtype:
            raise JobError(f"cannot be read ({name} is {array.dtype} {list(array.shape)})", path, MAKE_ANEW)
    if not (np.abs(arrays["xyz"]) <= _FARTHEST).all():  # false for what is no number, too
        raise JobError("holds positions that are no numbers, or absurdly far away", path, MAKE_ANEW)
    return kind(**arrays)


def _read_instances(path: Path) -> tuple[ClassTable, tuple[Instance, ...]]:
    try:
        content: Any = read_object(path, MAKE_ANEW)
        if content["format"] != _FORMAT:
            fix = "Use the version of PLGS that wrote it, or lift into another folder."
            raise JobError(f"has format {content['format']!r}, this version reads {_FORMAT}", path, fix)
        categories = [
            Category(_id(each["id"]), _text(each["name"]), bool(each["is_thing"]), _colour(each["colour"]))
            for each in content["classes"]
        ]
        instances = tuple(_instance(each) for each in content["instances"])
        for kind, rows in (("class", categories), ("instance", instances)):
            if len({row.id for row in rows}) < len(rows):
                raise ValueError(f"one {kind} id stands there twice")
        return ClassTable(tuple(sorted(categories, key=lambda category: category.id))), instances
    except _BAD as error:
        raise JobError(f"cannot be read ({error!r})", path, MAKE_ANEW) from error


def _instance(entry: dict[str, Any]) -> Instance:
    return Instance(
        id=_id(entry["id"]),
        name=_text(entry["name"]),
        class_id=_id(entry["class_id"]),
        class_name=_text(entry["class_name"]),
        colour=_colour(entry["colour"]),
        centre=_floats(entry["centre"], 3),
        size=_floats(entry["size"], 3),
        rotation=_floats(entry["rotation"], 4),
        views=_whole(entry["views"]),
        score=_number(entry["score"]),
        points=_whole(entry["points"]),
        masks=tuple(_mask(each) for each in entry.get("segments", ())),
    )


def _mask(entry: dict[str, Any]) -> Mask:
    cost, agreement = entry.get("cost"), entry.get("agreement")
    return Mask(
        frame=_text(entry["frame"]),
        segment_id=_whole(entry["segment_id"]),
        class_id=_id(entry["class_id"]),
        score=_number(entry["score"]),
        cost=None if cost is None else _number(cost),
        agreement=None if agreement is None else _number(agreement),
        pixels=_whole(entry.get("pixels", 0)),
        share=_number(entry.get("share", 0.0)),
        rectangle=_floats(entry.get("rectangle", (0.0, 0.0, 0.0, 0.0)), 4),
    )


def _colour(value: Any) -> tuple[int, int, int]:
    red, green, blue = (_whole(part) for part in value)
    if max(red, green, blue) > 255:
        raise ValueError(f"{value!r} is no colour")
    return red, green, blue


def _whole(value: Any) -> int:
    number = int(value)
    if not 0 <= number <= _LARGEST:
        raise ValueError(f"{value!r} is not from 0 to {_LARGEST}")
    return number


def _id(value: Any) -> int:
    """Palettes and lists have a place for each id up to the largest."""
    number = _whole(value)
    if number > LARGEST_ID:
        raise ValueError(f"{value!r} is larger than any id, {LARGEST_ID}")
    return number


def _text(value: Any) -> str:
    text = str(value)
    text.encode()  # half of a surrogate pair is no text; UnicodeEncodeError is a ValueError
    return text


def _number(value: Any) -> float:
    return float(_floats([value], 1)[0])


def _floats(value: Any, count: int) -> Any:
    numbers = tuple(float(part) for part in value)
    if len(numbers) != count or not all(abs(number) <= _FARTHEST for number in numbers):
        raise ValueError(f"{value!r} is not {count} numbers of a usual size")
    return numbers
