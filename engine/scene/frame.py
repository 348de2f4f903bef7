"""A frame: one posed colour image with depth, a panoptic mask and, for evaluation only, ground truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..gates import printable
from .camera import Camera
from .classes import ClassTable
from .sparse_points import SparsePoints

Size = tuple[int, int]
"""(width, height) in pixels."""


@dataclass(frozen=True)
class Segment:
    """One region of a panoptic mask: its value ``id`` in the pixels, its class, and the detector's score in [0, 1].

    ``is_group``: a region of a thing's class without an instance, which may be several objects: it tells the class, and
    founds no object. ``track``: the object's id over all frames, where a tracker followed it; None elsewhere.
    """

    id: int
    class_id: int
    is_thing: bool
    score: float = 1.0
    is_group: bool = False
    track: int | None = None


@dataclass(frozen=True, eq=False)
class PanopticMask:
    """Segment ids, int32 [H, W] with 0 = void, and what each id means. Ids say nothing across views; tracks do."""

    ids: NDArray[np.int32]
    segments: tuple[Segment, ...]

    def class_map(self) -> NDArray[np.int32]:
        """Class id of every pixel, int32 [H, W], 0 = void."""
        table = np.zeros(int(self.ids.max(initial=0)) + 1, np.int32)
        for segment in self.segments:
            if segment.id < len(table):
                table[segment.id] = segment.class_id
        return table[self.ids]


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """True class ids and instance ids (0 = stuff or none), int32 [H, W] each. Serves metrics only."""

    semantic: NDArray[np.int32]
    instance: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Frame:
    """One view. Pixels are read when asked for: each reader is called with a size (width, height) or None for its own.

    ``read_colour`` gives uint8 [H, W, 3] RGB, ``read_depth`` float32 [H, W] planar metres (0 = none), ``read_mask`` a
    PanopticMask, ``read_ground_truth`` a GroundTruth; the last three are None where there is none. They raise
    SceneError. ``colour_path`` and ``depth_path`` are the files that the pixels come out of.
    ``file_shows_colour`` is whether the file at ``colour_path`` is an image that looks as ``read_colour`` does: not so
    in a video or an archive, and where the lens is undistorted on reading.
    """

    name: str
    camera: Camera
    held_out: bool
    colour_path: Path
    depth_path: Path | None
    read_colour: Callable[[Size | None], NDArray[np.uint8]]
    read_depth: Callable[[Size | None], NDArray[np.float32]] | None
    read_mask: Callable[[Size | None], PanopticMask] | None
    read_ground_truth: Callable[[Size | None], GroundTruth] | None = None
    file_shows_colour: bool = True

    @property
    def size(self) -> Size:
        return self.camera.width, self.camera.height

    def depth(self, size: Size | None = None) -> NDArray[np.float32]:
        """``read_depth`` of a frame that must have it. Raises SceneError."""
        if self.read_depth is None:
            raise SceneError("a frame has no depth", self.colour_path, "Give depth for every frame.")
        return self.read_depth(size)

    def mask(self, size: Size | None = None) -> PanopticMask:
        """``read_mask`` of a frame that must have it. Raises SceneError."""
        if self.read_mask is None:
            raise SceneError("a frame has no mask", self.colour_path, "Give a panoptic mask for every frame.")
        return self.read_mask(size)


@dataclass(frozen=True, eq=False)
class Scene:
    """Posed frames in recording order, the classes their masks use, and what a user should know about them.

    ``folder`` is what the user named: a folder, or the one file that holds it all. ``format`` names the reader that
    took it. ``points`` are those of the reconstruction that the poses come from, where the format has them. ``turn``,
    float64 [3, 3], is how the world of the poses was turned for z to point up; None where it was not.
    """

    folder: Path
    frames: tuple[Frame, ...]
    classes: ClassTable
    warnings: tuple[str, ...] = ()
    format: str = "scannet"
    points: SparsePoints | None = None
    turn: NDArray[np.float64] | None = None

    @property
    def train_frames(self) -> tuple[Frame, ...]:
        return tuple(frame for frame in self.frames if not frame.held_out)

    @property
    def test_frames(self) -> tuple[Frame, ...]:
        return tuple(frame for frame in self.frames if frame.held_out)

    @property
    def has_depth(self) -> bool:
        return all(frame.read_depth is not None for frame in self.frames)

    @property
    def has_masks(self) -> bool:
        return all(frame.read_mask is not None for frame in self.frames)


class SceneError(Exception):
    """Input that cannot be lifted: what is wrong, where (a file or folder), and what to do about it."""

    def __init__(self, what: str, where: Path | str, fix: str) -> None:
        super().__init__(printable(f"{what}: {where}. {fix}").replace("\n", " "))
        self.what, self.where, self.fix = what, str(where), fix
