"""A frame: one posed colour image with depth, a panoptic mask and, for evaluation only, ground truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from .camera import Camera
from .classes import ClassTable

Size = tuple[int, int]
"""(width, height) in pixels."""


@dataclass(frozen=True)
class Segment:
    """One region of a panoptic mask: its value ``id`` in the pixels, its class, and the detector's score in [0, 1].

    ``is_group`` marks a region of a thing's class without an instance. It may show several objects, so it gives its
    pixels a class and founds no object. ``track`` is the object's id over all frames, None without a tracker.
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
class SparsePoints:
    """The points of the reconstruction that a scene's poses come from.

    ``xyz`` is float64 [N, 3] in the world of the poses, ``rgb`` uint8 [N, 3] sRGB. ``seen_by`` maps a frame's name to
    the indices int64 [K] of the points that were found in its picture. It is empty in formats without tracks.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    seen_by: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.xyz)

    def turned(self, turn: NDArray[np.float64]) -> SparsePoints:
        """The same points in the world that the rotation ``turn``, float64 [3, 3], makes."""
        return SparsePoints(self.xyz @ turn.T, self.rgb, self.seen_by)


@dataclass(frozen=True, eq=False)
class Frame:
    """One view. Pixels are read on demand: each reader is called with a size (width, height), or None for its own.

    ``read_colour`` gives uint8 [H, W, 3] RGB, ``read_depth`` float32 [H, W] planar metres (0 = none), ``read_mask`` a
    PanopticMask, ``read_ground_truth`` a GroundTruth. The last three may be None. Readers raise PlgsError.
    ``colour_path`` and ``depth_path`` are the files that hold the pixels. ``file_shows_colour`` is true when the file
    at ``colour_path`` is an image that looks as ``read_colour`` does. It is false for videos, archives, and pictures
    that are undistorted on reading.
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
        """``read_depth`` of a frame that must have it. Raises PlgsError."""
        if self.read_depth is None:
            raise PlgsError("a frame has no depth", self.colour_path, "Give depth for every frame.")
        return self.read_depth(size)

    def mask(self, size: Size | None = None) -> PanopticMask:
        """``read_mask`` of a frame that must have it. Raises PlgsError."""
        if self.read_mask is None:
            raise PlgsError("a frame has no mask", self.colour_path, "Give a panoptic mask for every frame.")
        return self.read_mask(size)


@dataclass(frozen=True, eq=False)
class Scene:
    """Posed frames in recording order, the classes their masks use, and what a user should know about them.

    ``folder`` is what the user named: a folder, or the one file that holds it all. ``format`` is the name of its
    reader. ``points`` are those of the reconstruction that the poses come from, if the format has them. ``turn``,
    float64 [3, 3], is the rotation that made z point up, or None.
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
