"""After training: the views' labels are voted onto the finished Gaussians, at the masks' own resolution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..instances import segment_labels
from ..model.label_voting import Contributors, LabelVotes, contributors, pixel_labels
from ..model.structured import GaussianLabels, StructuredScene
from ..scene import Frame, PanopticMask, Size, size_within
from ..scene.hole_filling import fill_holes
from ..scene.pixels import resize_nearest
from ..train.presets import Preset

MOST_BYTES = 1 << 29
"""What is kept of frames between two rounds; others are looked at anew."""


def vote_labels(
    scene: StructuredScene,
    frames: Sequence[Frame],
    label_maps: Sequence[NDArray[np.int16]],
    preset: Preset,
    progress: Callable[[int, int], None],
) -> GaussianLabels:
    """What the training frames vote every Gaussian to be.

    ``label_maps`` int16 [H, W] are the labels that the frames' pixels were given before training, at the size of
    training; the segments of the mask at its own size take them over. In every further round they take what the
    Gaussians of the round before show. Raises SceneError when a file is bad, and what ``progress`` raises.
    """
    channels = scene.channels
    count = len(channels.class_ids) + len(channels.instance_slots)
    voted: GaussianLabels | None = None
    looks: dict[str, _Look] = {}  # what does not change from round to round, as far as there is room
    for number in range(preset.vote_rounds):
        votes = LabelVotes(scene, preset.voting)
        for place, (frame, label_map) in enumerate(zip(frames, label_maps, strict=True)):
            look = looks.get(frame.name) or _look(scene, frame, preset)
            if preset.vote_rounds > 1 and len(looks) * look.bytes < MOST_BYTES:
                looks[frame.name] = look
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

    @property
    def bytes(self) -> int:
        arrays = (self.seen.gaussian, self.seen.weight, self.seen.depth, self.mask.ids, self.depth)
        return sum(each.nbytes for each in arrays)


def _look(scene: StructuredScene, frame: Frame, preset: Preset) -> _Look:
    size = size_within(frame.size, preset.vote_size_within)
    mask, depth = frame.mask(size), frame.depth(size)
    seen = contributors(scene, frame.camera.resized(*size), preset.voting.contributors)
    return _Look(seen, mask, fill_holes(depth, mask.ids))
