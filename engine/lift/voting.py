"""After training: the views' labels are voted onto the finished Gaussians, at the masks' own resolution."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..instances import segment_labels
from ..model.label_voting import LabelVotes, contributors, pixel_labels
from ..model.structured import GaussianLabels, StructuredScene
from ..scene import Frame, PanopticMask, size_within
from ..scene.hole_filling import fill_holes
from ..scene.pixels import resize_nearest
from ..train.presets import Preset


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
    for number in range(preset.vote_rounds):
        votes = LabelVotes(scene, preset.voting)
        for place, (frame, label_map) in enumerate(zip(frames, label_maps, strict=True)):
            size = size_within(frame.size, preset.vote_size_within)
            mask, depth = frame.mask(size), frame.depth(size)
            seen = contributors(scene, frame.camera.resized(*size), preset.voting.contributors)
            shown = resize_nearest(label_map, size) if voted is None else pixel_labels(scene, voted, seen)
            votes.add(seen, _of_segments(mask, shown, count, preset), fill_holes(depth, mask.ids))
            progress(number * len(frames) + place + 1, preset.vote_rounds * len(frames))
        voted = votes.result()
    assert voted is not None  # there is at least one round
    return voted


def _of_segments(mask: PanopticMask, shown: NDArray[np.int16], count: int, preset: Preset) -> NDArray[np.int16]:
    return segment_labels(mask, shown, count, preset.segment_voting.agreement)
