"""Posed frames as JSON, in a lift's scene.json and in the frames.json of pictures that an engine made.

Blender reads no layout except plain folders. It takes the cameras of all other scenes from here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .camera import Camera
from .frames import PosedFrame, PosedScene

Row = tuple[float, float, float, float]


@dataclass(frozen=True)
class StoredFrame:
    """A posed frame. ``size`` is (width, height) in pixels, ``lens`` fx, fy, cx, cy in pixels with centres at +0.5.

    ``camera_to_world`` has OpenCV's axes and metres. ``colour`` and ``depth`` are paths, relative where they lie in the
    scene's folder. ``is_picture`` says that the file at ``colour`` shows the frame as it is, ``files`` is the digest of
    both when a lift was last run, ``read`` that of how they are read, confidence included. Lifts of earlier versions
    lack some of these: their photos are left to an engine, and what is not known is not compared.
    """

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
        """The frame with paths below the ``scene``'s folder."""
        camera = Camera(*self.size, *self.lens, np.array(self.camera_to_world))
        depth = None if self.depth is None else scene / self.depth
        return PosedFrame(
            self.name, camera, self.held_out, scene / self.colour, depth, file_shows_colour=self.is_picture
        )


@dataclass(frozen=True)
class StoredScene:
    """Posed frames in recording order. ``layout`` names the format's reader; ``masks`` is the digest of the masks that
    a lift was made from, empty where nothing was lifted."""

    frames: tuple[StoredFrame, ...]
    masks: str = ""
    layout: str = ""
    warnings: tuple[str, ...] = ()

    def posed_frames(self, scene: Path) -> tuple[PosedFrame, ...]:
        """The frames with paths below the ``scene``'s folder."""
        return tuple(frame.posed(scene) for frame in self.frames)


def stored_scene(scene: PosedScene, frames: Sequence[PosedFrame], masks: str = "") -> StoredScene:
    """``frames`` of a scene as a record."""
    return StoredScene(tuple(_stored(frame, scene.folder) for frame in frames), masks, scene.format, scene.warnings)


def _stored(frame: PosedFrame, scene: Path) -> StoredFrame:
    camera = frame.camera
    depth = None if frame.depth_path is None else _relative(frame.depth_path, scene)
    return StoredFrame(
        frame.name,
        frame.held_out,
        camera.size,
        (camera.fx, camera.fy, camera.cx, camera.cy),
        _rows(camera),
        _relative(frame.colour_path, scene),
        depth,
        frame.file_shows_colour,
    )


def _rows(camera: Camera) -> tuple[Row, Row, Row, Row]:
    one, two, three, four = (tuple(row) for row in camera.camera_to_world.tolist())
    return one, two, three, four


def _relative(path: Path, scene: Path) -> str:
    return path.relative_to(scene).as_posix() if path.is_relative_to(scene) else str(path)
