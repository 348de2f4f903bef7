"""Read a finished lift folder. Everything is checked before use, as somebody else may have written it. instances.json
is read in parts, so that the window does not freeze."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ..engine.corrections import Edit, read_corrected
from ..engine.errors import PlgsError
from ..engine.job import LiftFolder, ListedFile, check_sizes
from ..engine.job.manifest import MAKE_ANEW, verify_files
from ..engine.job.report import not_shown, read_metrics
from ..engine.known_scene import known_scene
from ..engine.posed import ClassTable, PosedScene
from ..engine.result_files import (
    ANCHORS,
    BAD,
    INSTANCES,
    SEMANTIC_POINTS,
    Anchors,
    Instance,
    Listed,
    SemanticPoints,
    instance_of,
    instances_text,
    read_instances,
)

MOST_INSTANCES = 5_000
"""A lift finds at most 4000 objects. A file with more is not a lift's and would block Blender for minutes."""
MOST_CLASSES = 10_000
"""Open Images, the largest public table, has 9 600 classes with masks of objects. Each takes 0.1 ms here."""
_USUAL, _LONGEST, _TABLE = 1 << 16, 1 << 23, 1 << 24
"""Characters of one object with its masks, usually and at most (ten thousand masks), and of the table of up to 65 534
classes. Four million are read in a fifth of a second."""
_SPACE = re.compile(r"[ \t\n\r]*")


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


_DECODER = json.JSONDecoder(parse_constant=_refuse)  # NaN and Infinity, which JSON lacks


def reading_instances(path: Path) -> Generator[None, None, Listed]:
    """Read instances.json object by object, as `read_instances` does. Raises PlgsError, also for too many objects."""
    try:
        content: dict[str, Any] = {"instances": []}
        for key, value in _Reader(instances_text(path)).members():
            if key != "instances":
                content[key] = value
                continue
            content[key].append(instance_of(value))
            refuse_too_many(content[key], path)
            yield
    except BAD as error:
        if "format" in content:  # of another version, whose objects are others
            read_instances(path, content | {"classes": [], "instances": []})
        raise PlgsError("instances-damaged", f"cannot be read ({error!r})", path, MAKE_ANEW) from error
    return read_instances(path, content)


Version = tuple[Path, tuple[int, int] | None]
"""The path of an instances.json, and its time in nanoseconds and size in bytes; None without such a file."""
_kept: dict[Version, Listed] = {}  # what was read last
_begun: dict[Version, Generator[None, None, Listed]] = {}  # what is being read


def version_of(lift: Path) -> Version:
    """Return a value that changes with a lift's instances.json."""
    path = lift / "result" / INSTANCES
    at = path.stat() if path.is_file() else None
    return path, at and (at.st_mtime_ns, at.st_size)


def reading_listed(version: Version) -> Generator[None, None, Listed]:
    """Parse an instances.json in parts; only the latest version is cached. Raises PlgsError if it is damaged."""
    listed = yield from reading_instances(version[0])
    _kept.clear()
    _kept[version] = listed
    return listed


def listed_in(lift: Path) -> Listed:
    """A lift's instances.json, cached: edits come in series, and reading takes long. Raises PlgsError if it is bad."""
    version = begin_to_read(lift)
    read_on(math.inf)
    return _kept[version]


def begin_to_read(lift: Path) -> Version:
    """Make ``read_on`` read this lift's instances.json, and no other lift's, unless it is cached."""
    version = version_of(lift)
    parts = _begun.get(version)
    _begun.clear()
    if version not in _kept:
        _begun[version] = parts or reading_listed(version)
    return version


def read_on(seconds: float) -> bool:
    """Read on for about so many seconds. Returns whether anything is left. Raises PlgsError if the file is damaged."""
    until = time.monotonic() + seconds
    for version, parts in [*_begun.items()]:
        del _begun[version]
        for _ in parts:
            if time.monotonic() >= until:
                _begun[version] = parts
                return True
    return False


def refuse_too_many(found: Sequence[object], path: Path, most: int = MOST_INSTANCES, kind: str = "objects") -> None:
    """Raise PlgsError if ``found``, the objects (or another ``kind``) in the file ``path``, are more than ``most``."""
    if len(found) > most:
        fix = "Lift it again with a smaller most_instances, or with masks of fewer classes."
        raise PlgsError("too-many", f"has more than {most} {kind}, which are too many for Blender", path, fix)


class _Reader:
    """Reads a JSON text piece by piece. Its methods raise ValueError and RecursionError."""

    def __init__(self, text: str) -> None:
        self._text, self._at = text, 0

    def members(self) -> Iterator[tuple[str, Any]]:
        """Yield the keys and values of an object. The elements of its list of instances are yielded one by one."""
        mark = self._mark("{") and ","
        while mark == ",":
            key = self._value()
            self._mark(":")
            if key != "instances":
                yield key, self._value(_TABLE)
            elif self._mark("[") and not self._mark("]", needed=False):
                each = ","
                while each == ",":
                    yield key, self._value()
                    each = self._mark(",]")
            mark = self._mark(",}")
        if self._next() < len(self._text):
            raise ValueError("something follows the JSON object")

    def _mark(self, marks: str, *, needed: bool = True) -> str:
        """Consume and return the next character if it is among ``marks``. Else return "" or, if ``needed``, fail."""
        at = self._next()
        found = self._text[at : at + 1]
        if found and found in marks:
            self._at = at + 1
            return found
        if needed:
            raise ValueError(f"the JSON is cut off or broken at character {at}")
        return ""

    def _value(self, longest: int = _LONGEST) -> Any:
        at = self._next()
        for size in (_USUAL, longest):
            try:
                value, used = _DECODER.raw_decode(self._text[at : at + size])
                break
            except json.JSONDecodeError:
                if at + size >= len(self._text):
                    raise
                if size == longest:
                    what = f"of more than {longest} characters, which would keep Blender's window waiting"
                    raise ValueError(f"something {what}, begins at character {at}") from None
        self._at = at + used
        return value

    def _next(self) -> int:
        found = _SPACE.match(self._text, self._at)
        return found.end() if found else self._at


_READ = (SEMANTIC_POINTS, ANCHORS, INSTANCES)
_MOST_HASHED = 1 << 26
"""Maximum number of bytes compared with the manifest's checksums, usually in a tenth of a second."""

Result = TypeVar("Result")


def result_of(parts: Generator[None, None, Result]) -> Result:
    """Run all parts of a generator at once, and return its result."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            return cast(Result, end.value)


@dataclass(frozen=True, eq=False)
class LiftResult:
    """A finished lift with its corrections: its frames and its output. `passes` are the EXR files of frames, by frame
    name; `shots` those of other cameras, by camera name. `not_shown`: objects that the masks show well and the lift
    lacks, in words, each with the frame that shows it best. `estimated`: see `Manifest`. `label_fingerprint` identifies
    the edits that change more than names. `removed` are the objects that were taken out of the room; `splats` corrects
    the rows of gaussians.ply."""

    folder: Path
    scene: PosedScene
    classes: ClassTable
    instances: tuple[Instance, ...]
    points: SemanticPoints
    anchors: Anchors
    passes: dict[str, Path]
    shots: dict[str, Path] = field(default_factory=dict)
    edits: tuple[Edit, ...] = ()
    label_fingerprint: str = ""
    not_shown: tuple[tuple[str, str], ...] = ()
    estimated: tuple[str, ...] = ()
    removed: tuple[Instance, ...] = ()
    splats: Callable[[NDArray[np.void]], NDArray[np.void]] = lambda rows: rows

    @property
    def name(self) -> str:
        """The name of the scene's folder, for display."""
        return self.scene.folder.name


def read_result(folder: Path) -> LiftResult:
    """Read a finished lift and its frames' cameras. Raises PlgsError for no lift, an unfinished or a damaged one."""
    return result_of(reading_result(folder))


def reading_result(folder: Path) -> Generator[None, None, LiftResult]:
    """Read a lift in parts, so that the window does not freeze. Returns and raises what `read_result` does."""
    lift = LiftFolder.open(folder)
    lift.refuse_foreign()
    manifest = check_sizes(lift.result_path)
    listed = {str(file.path): file for file in manifest.files}
    paths = (lift.result_path / path for path in listed)
    exrs = sorted(path for path in paths if path.parent == lift.passes_path and path.suffix == ".exr")
    _verify(lift, [*_READ, *(path.relative_to(lift.result_path).as_posix() for path in exrs)], listed)
    yield
    instances = yield from reading_listed(version_of(lift.path))
    corrected = read_corrected(lift.path, instances)
    refuse_too_many(corrected.instances, lift.result_path / INSTANCES)  # edits split objects
    refuse_too_many(corrected.classes.categories, lift.result_path / INSTANCES, MOST_CLASSES, "classes")
    yield
    scene = known_scene(lift, corrected.classes)
    by_name = {manifest.frames.get(path.stem, path.stem): path for path in exrs}
    passes = {frame.name: by_name[frame.name] for frame in scene.frames if frame.name in by_name}
    return LiftResult(
        folder=lift.path,
        scene=scene,
        classes=corrected.classes,
        instances=corrected.instances,
        points=corrected.points,
        anchors=corrected.anchors(),
        passes=passes,
        edits=corrected.edits,
        label_fingerprint=corrected.label_fingerprint,
        not_shown=tuple(not_shown(read_metrics(lift))) if "metrics.json" in listed else (),
        estimated=manifest.estimated,
        shots={name: path for name, path in by_name.items() if name not in passes},
        removed=corrected.removed,
        splats=corrected.splats,
    )


def _verify(lift: LiftFolder, paths: Iterable[str], listed: Mapping[str, ListedFile]) -> None:
    """Raise PlgsError unless what Blender opens has the manifest's checksums (of passes, at most _MOST_HASHED)."""
    files, size = [], 0
    for path in paths:
        if path not in listed:
            raise PlgsError("not-listed", f"does not list {path}", lift.manifest_path, MAKE_ANEW)
        size += listed[path].bytes
        if size > _MOST_HASHED and path not in _READ:
            break
        files.append(listed[path])
    verify_files(lift.result_path, files)
