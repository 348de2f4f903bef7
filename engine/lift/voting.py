"""After training: the views' labels are voted onto the finished Gaussians, at the masks' own resolution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..instances import segment_labels
from ..model.label_voting import Contributors, LabelVotes, contributors, pixel_labels
from ..model.structured import GaussianLabels, StructuredScene
from ..scene import Frame, PanopticMask, Segment, Size, StoredArrays, size_within
from ..scene.hole_filling import fill_holes
from ..scene.pixels import resize_nearest
from ..train.presets import Preset

MOST_BYTES = 1 << 32
"""What is stored on disk of frames between two rounds."""


def vote_labels(
    scene: StructuredScene,
    frames: Sequence[Frame],
    label_maps: Sequence[NDArray[np.int16]],
    preset: Preset,
    progress: Callable[[int, int], None],
    scratch: Path | None = None,
) -> GaussianLabels:
    """What the training frames vote every Gaussian to be.

    ``label_maps`` int16 [H, W] are the labels that the frames' pixels were given before training, at the size of
    training; the segments of the mask at its own size take them over. In every further round they take what the
    Gaussians of the round before show. What does not change from round to round waits in temporary files in
    ``scratch``. Raises SceneError when a file is bad, and what ``progress`` raises.
    """
    channels = scene.channels
    count = len(channels.class_ids) + len(channels.instance_slots)
    voted: GaussianLabels | None = None
    looks = _Looks(scene, frames, preset, scratch)
    for number in range(preset.vote_rounds):
        votes = LabelVotes(scene, preset.voting)
        for place, label_map in enumerate(label_maps):
            look = looks.at(place)
            shown = pixel_labels(scene, voted, look.seen) if voted else resize_nearest(label_map, look.size)
            agreed = segment_labels(look.mask, shown, count, preset.segment_voting.agreement)
            votes.add(look.seen, agreed, look.depth)
            progress(number * len(frames) + place + 1, preset.vote_rounds * len(frames))
        voted = votes.result()
    assert voted is not None  # there is at least one round
    return voted


@dataclass(frozen=True, eq=False)
class _Look:
    """A frame as it votes: which Gaussians its pixels show, its mask, and its filled depth."""

    seen: Contributors
    mask: PanopticMask
    depth: NDArray[np.float32]

    @property
    def size(self) -> Size:
        height, width = self.depth.shape
        return width, height


class _Looks:
    """The frames as they vote, each rendered once and read back from disk in later rounds, as far as MOST_BYTES go;
    the others are rendered anew."""

    def __init__(self, scene: StructuredScene, frames: Sequence[Frame], preset: Preset, scratch: Path | None) -> None:
        self.scene, self.frames, self.preset = scene, frames, preset
        self._arrays = StoredArrays(scratch)
        self._stored: dict[int, tuple[list[int], tuple[Segment, ...]]] = {}

    def at(self, place: int) -> _Look:
        """Of the frame in that place. Raises SceneError, OSError when the disk is full."""
        if place in self._stored:
            numbers, segments = self._stored[place]
            gaussian, weight, drawn, ids, depth = (self._arrays[number] for number in numbers)
            return _Look(Contributors(gaussian, weight, drawn), PanopticMask(ids, segments), depth)
        look = _look(self.scene, self.frames[place], self.preset)
        if self.preset.vote_rounds > 1 and self._arrays.nbytes < MOST_BYTES:
            arrays = (look.seen.gaussian, look.seen.weight, look.seen.depth, look.mask.ids, look.depth)
            self._stored[place] = [self._arrays.append(array) for array in arrays], look.mask.segments
        return look


def _look(scene: StructuredScene, frame: Frame, preset: Preset) -> _Look:
    size = size_within(frame.size, preset.vote_size_within)
    mask, depth = frame.mask(size), frame.depth(size)
    seen = contributors(scene, frame.camera.resized(*size), preset.voting.contributors)
    return _Look(seen, mask, fill_holes(depth, mask.ids))
