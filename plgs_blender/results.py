"""Reading a finished lift folder: what it holds is checked before any of it is used."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar, cast

from ..engine.corrections import Edit, read_corrected
from ..engine.errors import PlgsError
from ..engine.job import LiftFolder, ListedFile, check_sizes
from ..engine.job.manifest import MAKE_ANEW, verify_files
from ..engine.job.report import not_shown, read_metrics
from ..engine.known_scene import known_scene
from ..engine.posed import ClassTable, PosedScene
from ..engine.result_files import (
    ANCHORS,
    INSTANCES,
    SEMANTIC_POINTS,
    Anchors,
    Instance,
    SemanticPoints,
)
from .instances_in_parts import reading_listed, refuse_too_many, version_of

_READ = (SEMANTIC_POINTS, ANCHORS, INSTANCES)
_MOST_HASHED = 1 << 26
"""At most this many bytes are compared with the manifest's checksums, usually in a tenth of a second."""

Result = TypeVar("Result")


def result_of(parts: Generator[None, None, Result]) -> Result:
    """Do all parts at once, and return their result."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            return cast(Result, end.value)


@dataclass(frozen=True, eq=False)
class LiftResult:
    """A finished lift with its corrections: the frames it was made from and what came out. `passes` are the EXR files
    of frames, by frame name; `shots` are those of other cameras, by camera name. `not_shown`: what the masks show well
    and the lift does not, in words, and the frame that shows it best. `fingerprint` is that of
    the edits that change what is shown."""

    folder: Path
    scene: PosedScene
    classes: ClassTable
    instances: tuple[Instance, ...]
    points: SemanticPoints
    anchors: Anchors
    passes: dict[str, Path]
    shots: dict[str, Path] = field(default_factory=dict)
    edits: tuple[Edit, ...] = ()
    fingerprint: str = ""
    not_shown: tuple[tuple[str, str], ...] = ()

    @property
    def name(self) -> str:
        """The scene's folder name: what people call it."""
        return self.scene.folder.name


def read_result(folder: Path) -> LiftResult:
    """Read the result of a finished lift, and the cameras of its frames. Raises PlgsError when the folder is not a
    lift, is not finished, or was damaged.
    """
    return result_of(reading_result(folder))


def reading_result(folder: Path) -> Generator[None, None, LiftResult]:
    """`read_result` in parts, for a window that must not wait. Raises PlgsError."""
    lift = LiftFolder.open(folder)
    lift.refuse_foreign()
    manifest = check_sizes(lift.result_path)
    listed = {str(file.path): file for file in manifest.files}
    exrs = _listed_passes(lift, listed)
    _verify(lift, [*_READ, *(path.relative_to(lift.result_path).as_posix() for path in exrs)], listed)
    yield
    instances = yield from reading_listed(version_of(lift.path))
    corrected = read_corrected(lift.path, instances)
    refuse_too_many(corrected.instances, lift.result_path / INSTANCES)  # edits split objects
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
        fingerprint=corrected.fingerprint,
        not_shown=tuple(not_shown(read_metrics(lift))) if "metrics.json" in listed else (),
        shots={name: path for name, path in by_name.items() if name not in passes},
    )


def _verify(lift: LiftFolder, paths: Iterable[str], listed: Mapping[str, ListedFile]) -> None:
    """Compare what Blender opens with the manifest's checksums, before anything is changed. Raises PlgsError.

    So damage on the disk is reported, not placed. The window waits meanwhile, so only the first passes are compared,
    up to _MOST_HASHED.
    """
    files, size = [], 0
    for path in paths:
        if path not in listed:
            raise PlgsError("is not listed", lift.manifest_path, MAKE_ANEW)
        size += listed[path].bytes
        if size > _MOST_HASHED and path not in _READ:
            break
        files.append(listed[path])
    verify_files(lift.result_path, files)


def _listed_passes(lift: LiftFolder, listed: Iterable[str]) -> list[Path]:
    """The EXR files that the manifest lists, by name."""
    paths = (lift.result_path / path for path in listed)
    return sorted(path for path in paths if path.parent == lift.passes_path and path.suffix == ".exr")
