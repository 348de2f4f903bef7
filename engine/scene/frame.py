"""Frames (posed colour images with depth, panoptic masks and, for evaluation only, ground truth) and scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..posed.frames import PosedFrame, PosedScene, Size
from ..posed.frames import SparsePoints as SparsePoints
from ..posed.plain_folders import left_out_warning


@dataclass(frozen=True)
class Inferred:
    """Something that was inferred as no file says it: ``about`` which subject, what was ``taken``, and the ``reason``.
    If it ``is_doubtful``, users get it as a warning, too."""

    about: Literal[
        "format", "lens", "principal point", "depth's lens", "units", "axes", "numbering", "split", "up axis",
        "orientation", "masks' borders", "masks' lens", "detections' numbers", "detections' pictures", "depth",
        "licence",
    ]  # fmt: skip
    taken: str
    reason: str
    is_doubtful: bool = True

    def __str__(self) -> str:
        return f"{self.taken}: {self.reason}"


@dataclass(frozen=True)
class LeftOut:
    """The ``names`` of frames that are left out of a scene, and what they lack."""

    lacks: str
    names: tuple[str, ...]

    def __str__(self) -> str:
        return left_out_warning(self.names, self.lacks)


def counted(left_out: Iterable[LeftOut]) -> list[dict[str, object]]:
    """Return how many frames were left out for each reason, for JSON."""
    return [{"lacks": each.lacks, "count": len(each.names), "names": list(each.names)} for each in left_out]


def doubts(inferred: Iterable[Inferred]) -> tuple[str, ...]:
    """Return the doubtful ones of what was inferred, as warnings."""
    return tuple(str(each) for each in inferred if each.is_doubtful)


def left_out(lacks: str, names: Iterable[str]) -> tuple[LeftOut, ...]:
    """Return a note of the frames left out because of what they lack; empty without ``names``."""
    found = tuple(names)
    return (LeftOut(lacks, found),) if found else ()


@dataclass(frozen=True)
class Segment:
    """One region of a panoptic mask: its value ``id`` in the pixels, its class (a thing, or stuff), and the detector's
    score in [0, 1]. ``is_group`` marks a region of a thing's class without an instance: it may be several objects, so
    it gives its pixels a class but creates no object. ``track`` is the object's id in all frames, None without a
    tracker. A detection with several classes is a segment for each; ``share`` is this class's part of its vote."""

    id: int
    class_id: int
    is_thing: bool
    score: float = 1.0
    is_group: bool = False
    track: int | None = None
    share: float = 1.0


def mapped(ids: NDArray[np.integer], values: Mapping[int, float], other: NDArray[Any]) -> NDArray[Any]:
    """Look up the value of each id [H, W] (>= 0) in ``values``. The result [H, W] has the type of ``other`` [1], which
    holds the value of ids that are not listed."""
    table = np.repeat(other, int(ids.max(initial=0)) + 1)
    for number, value in values.items():
        if number < len(table):  # else no pixel has it
            table[number] = value
    return table[ids]


@dataclass(frozen=True, eq=False)
class PanopticMask:
    """A panoptic mask: segment ids, int32 [H, W], 0 = void, and segments. Ids differ between views; tracks do not."""

    ids: NDArray[np.int32]
    segments: tuple[Segment, ...]

    def class_map(self) -> NDArray[np.int32]:
        """Return the class id of every pixel, int32 [H, W], 0 = void."""
        return mapped(self.ids, {segment.id: segment.class_id for segment in self.segments}, np.zeros(1, np.int32))

    def share_map(self) -> NDArray[np.float32]:
        """Return the ``share`` of every pixel's segment, float32 [H, W]; 1 where there is no segment."""
        return mapped(self.ids, {segment.id: segment.share for segment in self.segments}, np.ones(1, np.float32))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a network detects in a frame, as segments that may overlap: ``inside`` bool [S, H, W], the pixels of each. A
    panoptic picture is the case in which none overlap."""

    segments: tuple[Segment, ...]
    inside: NDArray[np.bool_]

    @classmethod
    def of(cls, mask: PanopticMask) -> Evidence:
        """Return a panoptic picture as evidence: its segments, as masks that do not overlap."""
        segments = tuple(one for one in mask.segments if (mask.ids == one.id).any())
        return cls(segments, np.array([mask.ids == one.id for one in segments]).reshape(-1, *mask.ids.shape))

    def layers(self) -> tuple[PanopticMask, ...]:
        """Distribute the segments to panoptic pictures without overlaps. In descending order of score, each goes into
        the first picture that is free at its pixels; the ids in each picture count from 1."""
        layers: list[tuple[NDArray[np.int32], list[Segment]]] = []
        for place in sorted(range(len(self.segments)), key=lambda place: -self.segments[place].score):
            inside = self.inside[place]
            layer = next((each for each in layers if not each[0][inside].any()), None)
            if layer is None:
                layer = np.zeros(inside.shape, np.int32), []
                layers.append(layer)
            ids, segments = layer
            segments.append(replace(self.segments[place], id=len(segments) + 1))
            ids[inside] = len(segments)
        return tuple(PanopticMask(ids, tuple(segments)) for ids, segments in layers)


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """True class ids (``semantic``) and instance ids (``instance``, 0 = none), int32 [H, W]. Only metrics use it."""

    semantic: NDArray[np.int32]
    instance: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Frame(PosedFrame):
    """A frame whose pixels are read on demand: each reader is called with a size (width, height), or None for its own.
    ``read_colour`` returns uint8 [H, W, 3] RGB, ``read_depth`` float32 [H, W] planar metres (0 = none), ``read_mask`` a
    PanopticMask, ``read_ground_truth`` a GroundTruth, ``read_detections`` the Evidence of segments that lie over the
    mask. The last four may be None. Readers raise PlgsError. ``confidence_path`` is the file that says which depth to
    trust. ``read_as`` describes the distortion and the unit and lens of depth, as text, if unusual. ``read_kept``
    returns bool [H, W], the pixels that count; None if all do."""

    read_colour: Callable[[Size | None], NDArray[np.uint8]]
    read_depth: Callable[[Size | None], NDArray[np.float32]] | None
    read_mask: Callable[[Size | None], PanopticMask] | None
    read_ground_truth: Callable[[Size | None], GroundTruth] | None = None
    read_detections: Callable[[Size | None], Evidence] | None = None
    confidence_path: Path | None = None
    read_as: str = ""
    read_kept: Callable[[Size], NDArray[np.bool_]] | None = None

    def depth(self, size: Size | None = None) -> NDArray[np.float32]:
        """Read the depth, float32 [H, W] in metres. Raises PlgsError if the frame has none, or its file is bad."""
        if self.read_depth is None:
            raise PlgsError("no-depth", "a frame has no depth", self.colour_path, "Give depth for every frame.")
        return self.read_depth(size)

    def mask(self, size: Size | None = None) -> PanopticMask:
        """Read the panoptic mask. Raises PlgsError if the frame has none, or its file is bad."""
        if self.read_mask is None:
            raise PlgsError("no-mask", "a frame has no mask", self.colour_path, "Give a panoptic mask for every frame.")
        return self.read_mask(size)

    def layers(self, size: Size | None = None) -> tuple[PanopticMask, ...]:
        """Read the detections over the mask, as masks without overlaps; () without any. Raises PlgsError for damage."""
        return () if self.read_detections is None else self.read_detections(size).layers()


@dataclass(frozen=True, eq=False)
class Scene(PosedScene):
    """Posed frames with their pixels, in recording order. ``warnings`` name what was ``left_out``, and the doubtful
    part of what was ``inferred``. ``fps`` is the frame rate by which the numbers in names count, None if unknown."""

    frames: tuple[Frame, ...]
    left_out: tuple[LeftOut, ...] = ()
    inferred: tuple[Inferred, ...] = ()
    fps: float | None = None

    @property
    def assumed_lens(self) -> str:
        """Return the warning that the lens is assumed; "" if a file describes it."""
        return next((str(each) for each in self.inferred if each.about == "lens" and each.is_doubtful), "")

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
