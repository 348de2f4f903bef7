"""Labels the finished Gaussians by a vote of the views at their masks' resolution; reads frames that only vote."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..instances.panoptic_labels import UNKNOWN_LABEL
from ..instances.segment_votes import segment_labels
from ..job import EventWriter
from ..model.label_voting import Contributors, LabelVotes, contributors, pixel_labels
from ..model.settling import NamedGaussians, OwnedPoints, settled
from ..model.structured import GaussianLabels, StructuredScene
from ..presets.preset import Preset
from ..scene import Frame, OtherClasses, PanopticMask, Segment, Size, size_within
from ..scene.hole_filling import fill_holes
from ..scene.pixels import resize_nearest
from ..scene.view import Progress, StoredArrays, StoredViews, View, read_ahead
from .objects import Matching, labels_of
from .objects_in_view import LEAST_SHOWN, ObjectsInView, objects_in_view, with_hidden_objects

MOST_BYTES = 1 << 32
"""The most bytes of frames that are stored on disk between two rounds."""
MOST_VIEWS = 100
"""At most this many views say whether every object is shown, evenly chosen."""
ROUNDS = 2
"""Rounds in which the views vote on the Gaussians where their masks agree."""


def vote_labels(
    scene: StructuredScene,
    frames: Sequence[Frame],
    prepared: Matching,
    preset: Preset,
    *,
    progress: Progress,
    scratch: Path | None = None,
) -> tuple[GaussianLabels, ObjectsInView]:
    """Let the training frames, reduced to fit ``vote_size``, vote on each Gaussian's labels. Return the labels, and how
    well they show every object. If the masks agree, they outline objects better than points do, and there are two
    rounds: first each mask's segments vote for the labels that matching gave them, then for the labels that the
    Gaussians show there. Otherwise each pixel votes once, for the label of its point. Data for both rounds is kept in
    temporary files in ``scratch``. Raises PlgsError if a file is bad."""
    cloud, maps = prepared.cloud, prepared.label_maps
    assert maps is not None  # objects by agreement come with them
    labels = labels_of(cloud, prepared.instances)
    label_of_point = np.append(labels.of_points(cloud.class_id, prepared.instance_of_point), UNKNOWN_LABEL)
    label_of_point = label_of_point.astype(np.int16)  # the last is that of pixels without a point
    point_index, reach = cloud.index(), 2 * cloud.spacing
    rounds = ROUNDS if prepared.masks_agree else 1
    voting_frames = _VotingFrames(scene, preset, scratch, most_bytes=MOST_BYTES)
    named = NamedGaussians(len(scene.anchors) * scene.anchors.gaussians_per_anchor)
    voted: GaussianLabels | None = None
    for number in range(rounds):
        votes = LabelVotes(scene, preset.evidence.gaussians)
        for index, frame in enumerate(read_ahead(frames, voting_frames.of)):
            if prepared.masks_agree:
                shown = pixel_labels(scene, voted, frame.seen) if voted else resize_nearest(maps[index], frame.size)
                shown = segment_labels(frame.mask, shown, len(labels))
            else:
                shown = label_of_point[point_index.nearest_of_pixels(frame.seen.camera, frame.depth, reach)]
            if number == 0:
                named.add(frame.seen, frame.mask.ids > 0)
            votes.add(frame.seen, shown, frame.depth, frames[index].size[0] / frame.size[0])
            progress(number * len(frames) + index + 1, (rounds + 1) * len(frames))
        voted = votes.result()
    assert voted is not None  # there is at least one round
    points = OwnedPoints(cloud.xyz, prepared.instance_of_point)
    labelled = settled(scene, voted, named.are_named, points)

    def some_views() -> Iterator[Contributors]:
        step = -(-len(frames) // MOST_VIEWS) or 1
        for done, frame in enumerate(read_ahead(frames[::step], voting_frames.of)):
            yield frame.seen
            progress(rounds * len(frames) + step * done + 1, (rounds + 1) * len(frames))

    found = objects_in_view(scene, labelled, some_views(), points)
    if (found.share < LEAST_SHOWN).any():
        labelled = with_hidden_objects(scene, labelled, found)
        found = objects_in_view(scene, labelled, some_views(), points)
    return labelled, found


@dataclass(frozen=True, eq=False)
class _VotingFrame:
    """What a frame needs to vote: the Gaussians that make up each pixel (``seen``), mask, depth with holes filled."""

    seen: Contributors
    mask: PanopticMask
    depth: NDArray[np.float32]

    @property
    def size(self) -> Size:
        height, width = self.depth.shape
        return width, height


class _VotingFrames:
    """The frames that vote. Each is rendered once and kept on disk, as long as all take at most ``most_bytes``."""

    def __init__(self, scene: StructuredScene, preset: Preset, scratch: Path | None, most_bytes: int) -> None:
        self.scene, self.preset, self.most_bytes = scene, preset, most_bytes
        self._arrays = StoredArrays(scratch)
        self._stored: dict[str, tuple[list[int], tuple[Segment, ...]]] = {}

    def of(self, source: Frame) -> _VotingFrame:
        """Return what ``source`` needs to vote, in any thread. Raises PlgsError if it cannot be read, OSError."""
        if source.name in self._stored:
            numbers, segments = self._stored[source.name]
            gaussian, weight, drawn, ids, depth = (self._arrays[number] for number in numbers)
            camera = source.camera.resized(drawn.shape[1], drawn.shape[0])
            return _VotingFrame(Contributors(gaussian, weight, drawn, camera), PanopticMask(ids, segments), depth)
        size = size_within(source.size, self.preset.vote_size)
        mask, depth = source.mask(size), source.depth(size)
        seen = contributors(self.scene, source.camera.resized(*size))
        frame = _VotingFrame(seen, mask, fill_holes(depth, mask.ids))
        if self._arrays.nbytes < self.most_bytes:
            arrays = (frame.seen.gaussian, frame.seen.weight, frame.seen.depth, frame.mask.ids, frame.depth)
            self._stored[source.name] = [self._arrays.append(array) for array in arrays], frame.mask.segments
        return frame


SMALLER = 2
"""The factor by which extra voting frames are smaller than training frames, in width and in height."""


def read_voters(
    frames: Sequence[Frame], preset: Preset, progress: Callable[[int], object], events: EventWriter, scratch: Path
) -> StoredViews:
    """Read depth and masks of ``frames`` into files in ``scratch``. Warns of frames that cannot be read; they do not
    vote. ``progress`` is called with the number of frames read. Raises OSError if the disk is full."""
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
        depth, mask, layers = frame.depth(size), frame.mask(size), frame.layers(size)
    except OtherClasses:
        raise
    except PlgsError as error:
        return error
    colour = np.zeros((*depth.shape, 3), np.uint8)  # nothing looks at the photos of these
    camera, scale = frame.camera.resized(*size), frame.size[0] / size[0]
    return View(frame.name, camera, colour, depth, mask, mask_scale=scale, layers=layers)
