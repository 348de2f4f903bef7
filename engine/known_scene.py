"""Stored facts about a scene's frames, for use without the scene: scene.json of a lift, frames.json of extracted
pictures. Blender reads only plain folders itself; of others it has cameras and pictures from these files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .errors import PlgsError
from .job import LiftFolder, write_atomically
from .job.own_files import NOTE, OwnFiles
from .posed import Camera, ClassTable, PosedFrame, PosedScene
from .records import read_record, record_text
from .result_files import INSTANCES, read_instances
from .scene_source import SceneSource

_MOST_WARNINGS = 1_000  # maximum number of warnings shown; a scene has tens
Row = tuple[float, float, float, float]


@dataclass(frozen=True)
class StoredFrame:
    """A frame as it is stored, ``held_out`` from training or not. ``size`` is (width, height) in pixels, ``lens`` fx,
    fy, cx, cy in pixels with centres at +0.5. ``camera_to_world`` has OpenCV's axes and metres. ``colour`` and
    ``depth`` are paths, relative if they lie in the scene's folder. ``is_picture`` says that the file at ``colour``
    shows the frame as it is. ``files`` is the digest of photo and depth when the lift last ran, ``read`` that of
    confidence and of how the files are read. A digest "" is not compared."""

    name: str = field(metadata={"shown": True})
    held_out: bool
    size: tuple[int, int] = field(metadata={"least": 1, "most": 1 << 20})
    lens: Row
    camera_to_world: tuple[Row, Row, Row, Row]
    colour: str
    depth: str | None = None
    is_picture: bool = False
    files: str = ""
    read: str = ""

    def posed(self, scene: Path) -> PosedFrame:
        """Return the posed frame, with paths in the scene's folder ``scene``."""
        camera = Camera(*self.size, *self.lens, np.array(self.camera_to_world))
        depth, colour = None if self.depth is None else scene / self.depth, scene / self.colour
        return PosedFrame(self.name, camera, self.held_out, colour, depth, file_shows_colour=self.is_picture)


@dataclass(frozen=True)
class StoredScene:
    """A scene's frames as they are stored, in recording order. ``layout`` names the format's reader; ``masks`` is the
    digest of a lift's masks, "" where nothing was lifted. ``estimated`` says what was not measured."""

    frames: tuple[StoredFrame, ...]
    masks: str = ""
    layout: str = ""
    warnings: tuple[str, ...] = ()
    estimated: tuple[str, ...] = ()

    def posed_frames(self, scene: Path) -> tuple[PosedFrame, ...]:
        """Return the posed frames, with paths in the scene's folder ``scene``."""
        return tuple(frame.posed(scene) for frame in self.frames)


def stored_scene(scene: PosedScene, frames: Sequence[PosedFrame], masks: str = "") -> StoredScene:
    """Return ``frames`` of a scene in the form in which they are stored, with the digest of the ``masks``."""
    known = tuple(_stored(frame, scene.folder) for frame in frames)
    return StoredScene(known, masks, scene.format, scene.warnings, scene.estimated)


def _stored(frame: PosedFrame, scene: Path) -> StoredFrame:
    camera, colour = frame.camera, _relative(frame.colour_path, scene)
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    one, two, three, four = (tuple(row) for row in camera.camera_to_world.tolist())
    depth = None if frame.depth_path is None else _relative(frame.depth_path, scene)
    pose = (one, two, three, four)
    return StoredFrame(frame.name, frame.held_out, camera.size, lens, pose, colour, depth, frame.file_shows_colour)


def _relative(path: Path, scene: Path) -> str:
    return path.relative_to(scene).as_posix() if path.is_relative_to(scene) else str(path)


KNOWN_SCENE = "scene.json"
"""File of a lift folder: the frames of its scene with their cameras."""
FIND_SCENE = "Say where the scene is now, with Find Scene or --scene."
_BAKE_FIX = "Delete this file, then let an engine bake a frame of the lift, which writes it again."


def known_scene(folder: LiftFolder, classes: ClassTable | None = None) -> PosedScene:
    """Return the frames of a lift with their cameras, without pixels, and its ``classes``, by default read from the
    result. Raises PlgsError for a lift without a list of its frames, and for a damaged one."""
    scene, known = folder.request.scene, read_known(folder)
    if known is None:
        fix = "Bake one of its frames, which writes the list."
        raise PlgsError("early-lift", "an early PLGS made this lift, with no list of its frames", folder.path, fix)
    classes = classes or read_instances(folder.result_path / INSTANCES)[0]
    frames, warnings = known.posed_frames(scene), known.warnings[:_MOST_WARNINGS]
    if not os.path.exists(scene):
        warnings = (f"the scene is not at {scene}, so there are no photos. {FIND_SCENE}",)
    return PosedScene(scene, frames, classes, warnings, known.layout)


def read_known(folder: LiftFolder) -> StoredScene | None:
    """Read a lift's scene.json; None if it has none. Raises PlgsError for a damaged one."""
    path = folder.path / KNOWN_SCENE
    return read_record(StoredScene, path, _BAKE_FIX) if path.is_file() else None


def write_known(folder: LiftFolder, known: StoredScene) -> None:
    """Write a lift's scene.json, beside its request. Raises OSError."""
    write_atomically(folder.path / KNOWN_SCENE, record_text(known))


FILE = "frames.json"
VERSION = 2
"""The version of frames.json. Version 1 had no cameras of frames without a picture."""
_MADE_FIX = "Delete the folder; it will be made again."
_INSIDE = {"inside": True}


@dataclass(frozen=True)
class MadeFrame:
    """The pictures that were made of one frame, None where there is none: its ``colour`` undistorted, its ``depth`` and
    ``masks`` drawn in colours. ``depth_range`` is the nearest and the farthest depth in metres that are drawn."""

    colour: Path | None = field(default=None, metadata=_INSIDE)
    depth: Path | None = field(default=None, metadata=_INSIDE)
    depth_range: tuple[float, float] | None = None
    masks: Path | None = field(default=None, metadata=_INSIDE)


@dataclass(frozen=True)
class MadeFrames:
    """What `make_frames` wrote into ``folder``: the cameras of all frames of the ``scene``, and the pictures by frame
    name. ``cloud`` (made of depth) and ``points`` (of the reconstruction that gave the poses) are .npz files with xyz
    float32 [N, 3] metres and rgb uint8 [N, 3], or None."""

    folder: Path = field(metadata={"apart": True})
    source: SceneSource
    scene: StoredScene
    frames: Mapping[str, MadeFrame] = field(default_factory=dict)
    cloud: Path | None = field(default=None, metadata=_INSIDE)
    points: Path | None = field(default=None, metadata=_INSIDE)

    def write(self) -> None:
        """Write frames.json into the folder. Raises OSError."""
        write_atomically(self.folder / FILE, record_text(self, self.folder, VERSION))

    @classmethod
    def read(cls, folder: Path) -> MadeFrames:
        """Read the frames.json of a folder. Raises PlgsError if it is missing, of another version, or damaged."""
        return read_record(cls, folder / FILE, _MADE_FIX, VERSION, folder=folder)


def made_of(folder: Path, source: SceneSource) -> MadeFrames | None:
    """Return what an earlier run made of this scene in ``folder``; None if the folder is new or empty. Raises PlgsError
    if it holds other files."""
    if not folder.exists():
        return None
    if (folder / FILE).is_file():
        made = MadeFrames.read(folder)
        if made.source == source and OwnFiles(folder).begun is not None:
            return made
    elif folder.is_dir() and not any(path.name != NOTE for path in folder.iterdir()):
        return None
    raise PlgsError("folder-used", "the folder exists already and holds something else", folder, "Name another folder.")


def is_newer(path: Path, source: Path) -> bool:
    """Whether the file ``path`` exists and is at least as new as ``source``."""
    try:
        return path.stat().st_mtime >= source.stat().st_mtime
    except OSError:
        return False
