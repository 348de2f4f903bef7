"""After training: the views' labels are voted onto the finished Gaussians, at the masks' own resolution. Before it,
frames that are not trained on are read to vote."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from ..errors import PlgsError
from ..instances.panoptic_labels import UNKNOWN_LABEL
from ..instances.segment_votes import segment_labels
from ..job import EventWriter
from ..model.label_voting import LabelVotes, contributors
from ..model.settling import NamedGaussians, OwnedPoints, settled
from ..model.structured import GaussianLabels, StructuredScene
from ..presets.preset import Preset
from ..scene import (
    Frame,
    OtherClasses,
    Progress,
    Size,
    StoredViews,
    View,
    read_ahead,
    size_within,
)
from ..scene.hole_filling import fill_holes
from .objects import Matching, labels_of


def vote_labels(
    scene: StructuredScene, frames: Sequence[Frame], prepared: Matching, preset: Preset, progress: Progress
) -> GaussianLabels:
    """The labels of every Gaussian, by a vote of the training frames.

    Each pixel of a frame, within ``vote_size``, shows the label of the point of the ``prepared`` cloud that lies there,
    and votes for the Gaussians that it is blended from. Where masks agree, they know outlines better than points do, so
    a segment takes the label that most of its pixels show. Where they contradict each other, that would take back what
    the points gained. Raises PlgsError if a file is bad, and what ``progress`` raises.
    """
    cloud = prepared.cloud
    labels = labels_of(cloud, prepared.instances)
    label_of_point = np.append(labels.of_points(cloud.class_id, prepared.instance_of_point), UNKNOWN_LABEL)
    label_of_point = label_of_point.astype(np.int16)  # the last is that of pixels without a point
    index, reach = cloud.index(), 2 * cloud.spacing
    votes = LabelVotes(scene, preset.voting, preset.evidence.gaussians)
    named = NamedGaussians(len(scene.anchors) * scene.anchors.gaussians_per_anchor)
    for done, frame in enumerate(frames, start=1):
        size = size_within(frame.size, preset.vote_size)
        camera, mask = frame.camera.resized(*size), frame.mask(size)
        depth = fill_holes(frame.depth(size), mask.ids)
        shown = label_of_point[index.nearest_of_pixels(camera, depth, reach)]
        if prepared.masks_agree:
            shown = segment_labels(mask, shown, len(labels))
        seen = contributors(scene, camera)
        named.add(seen, mask.ids > 0)
        votes.add(seen, shown, depth, frame.size[0] / size[0])
        progress(done, len(frames))
    return settled(scene, votes.result(), named.are_named, OwnedPoints(cloud.xyz, prepared.instance_of_point))


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
