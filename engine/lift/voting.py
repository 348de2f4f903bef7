"""After training: the views' labels are voted onto the finished Gaussians, at the masks' own resolution. Before it,
frames that are not trained on are read to vote."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..instances.segment_votes import segment_labels
from ..job import EventWriter
from ..model.label_voting import Contributors, LabelVotes, contributors, pixel_labels
from ..model.settling import NamedGaussians, OwnedPoints, settled
from ..model.structured import GaussianLabels, StructuredScene
from ..presets.preset import Preset
from ..scene import (
    Frame,
    OtherClasses,
    PanopticMask,
    Progress,
    Segment,
    Size,
    StoredArrays,
    StoredViews,
    View,
    read_ahead,
    size_within,
)
from ..scene.hole_filling import fill_holes
from ..scene.pixels import resize_nearest

MOST_BYTES = 1 << 32
"""The most bytes of frames that are stored on disk between two rounds."""


def vote_labels(
    scene: StructuredScene,
    frames: Sequence[Frame],
    label_maps: Sequence[NDArray[np.int16]],
    preset: Preset,
    progress: Progress,
    points: OwnedPoints,
    scratch: Path | None = None,
) -> GaussianLabels:
    """The labels of every Gaussian, by a vote of the training frames. ``points`` are the cloud's, with their objects.

    ``label_maps`` int16 [H, W] are the labels that the frames' pixels got before training, at the size of training. In
    the first round, the segments of the mask at its own size take these labels. In each later round they take the
    labels that the Gaussians of the previous round show. What does not change between rounds is stored in temporary
    files in ``scratch``. Raises PlgsError if a file is bad, and what ``progress`` raises.
    """
    channels = scene.channels
    count = len(channels.class_ids) + len(channels.instance_slots)
    voted: GaussianLabels | None = None
    voting_frames = _VotingFrames(scene, frames, preset, scratch)
    named = NamedGaussians(len(scene.anchors) * scene.anchors.gaussians_per_anchor)
    for number in range(preset.vote_rounds):
        votes = LabelVotes(scene, preset.voting, preset.evidence.gaussians)
        for place, label_map in enumerate(label_maps):
            frame = voting_frames.at(place)
            shown = pixel_labels(scene, voted, frame.seen) if voted else resize_nearest(label_map, frame.size)
            agreed = segment_labels(frame.mask, shown, count)
            if number == 0:
                named.add(frame.seen, frame.mask.ids > 0)
            votes.add(frame.seen, agreed, frame.depth, frames[place].size[0] / frame.size[0])
            progress(number * len(frames) + place + 1, preset.vote_rounds * len(frames))
        voted = votes.result()
    assert voted is not None  # there is at least one round
    return settled(scene, voted, named.are_named, points)


@dataclass(frozen=True, eq=False)
class _VotingFrame:
    """What a frame needs to vote: the Gaussians that its pixels show, its mask, and its filled depth."""

    seen: Contributors
    mask: PanopticMask
    depth: NDArray[np.float32]

    @property
    def size(self) -> Size:
        height, width = self.depth.shape
        return width, height


class _VotingFrames:
    """The frames that vote. Each is rendered once and read back from disk in later rounds, up to MOST_BYTES of them;
    the others are rendered again."""

    def __init__(self, scene: StructuredScene, frames: Sequence[Frame], preset: Preset, scratch: Path | None) -> None:
        self.scene, self.frames, self.preset = scene, frames, preset
        self._arrays = StoredArrays(scratch)
        self._stored: dict[int, tuple[list[int], tuple[Segment, ...]]] = {}

    def at(self, place: int) -> _VotingFrame:
        """The frame at this place. Raises PlgsError, and OSError if the disk is full."""
        if place in self._stored:
            numbers, segments = self._stored[place]
            gaussian, weight, drawn, ids, depth = (self._arrays[number] for number in numbers)
            camera = self.frames[place].camera.resized(drawn.shape[1], drawn.shape[0])
            return _VotingFrame(Contributors(gaussian, weight, drawn, camera), PanopticMask(ids, segments), depth)
        frame = _rendered(self.scene, self.frames[place], self.preset)
        if self.preset.vote_rounds > 1 and self._arrays.nbytes < MOST_BYTES:
            arrays = (frame.seen.gaussian, frame.seen.weight, frame.seen.depth, frame.mask.ids, frame.depth)
            self._stored[place] = [self._arrays.append(array) for array in arrays], frame.mask.segments
        return frame


def _rendered(scene: StructuredScene, frame: Frame, preset: Preset) -> _VotingFrame:
    size = size_within(frame.size, preset.vote_size)
    mask, depth = frame.mask(size), frame.depth(size)
    seen = contributors(scene, frame.camera.resized(*size))
    return _VotingFrame(seen, mask, fill_holes(depth, mask.ids))


SMALLER = 2
"""The factor by which voters are smaller than the training frames, in width and in height."""


def read_voters(
    frames: Sequence[Frame], preset: Preset, progress: Callable[[int], object], events: EventWriter, scratch: Path
) -> StoredViews:
    """The depth and masks of ``frames``, on disk. Frames that cannot be read do not vote; a warning says so.
    ``progress`` is called with the number of frames read. Raises OSError if the disk is full."""
    problems: list[PlgsError] = []

    def good() -> Iterator[View]:
        for done, read in enumerate(read_ahead(frames, lambda frame: _read_voter(frame, preset.size)), start=1):
            if isinstance(read, PlgsError):
                problems.append(read)
            else:
                yield read
            progress(done)

    views = StoredViews(good(), scratch)
    if problems:
        events.warning(f"{len(problems)} of {len(frames)} frames that are not trained on do not vote: {problems[0]}")
    return views


def _read_voter(frame: Frame, trained_within: Size) -> View | PlgsError:
    width, height = size_within(frame.size, trained_within)
    size = max(1, width // SMALLER), max(1, height // SMALLER)
    try:
        depth, mask = frame.depth(size), frame.mask(size)
    except OtherClasses:
        raise
    except PlgsError as error:
        return error
    colour = np.zeros((*depth.shape, 3), np.uint8)
    return View(frame.name, frame.camera.resized(*size), colour, depth, mask, mask_scale=frame.size[0] / size[0])
