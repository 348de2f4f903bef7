"""The photos around removed objects, each beside what the lift shows there."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..corrections.fills import cell_keys, cells_of
from ..lift.baking import FrameBaker
from ..passes.previews import colour_picture
from ..scene import Camera, Frame, size_within

WITHIN = (800, 800)
"""Photos are read at most this large."""
GROWN = 2
"""Pixels by which an object's outline in a photo is grown: the rim of its mask is not trusted."""
DARK, BRIGHT, LEAST_COMPARED = 12, 243, 500
"""A photo's exposure is compared by at least this many pixels with values between these."""
LARGEST_GAIN = 4.0
_STEP = 8  # a frame sees a box if it sees one of this many points along each of its sides


@dataclass(frozen=True, eq=False)
class PlateView:
    """A photo: ``colour`` float32 [H, W, 3] sRGB in [0, 1], as bright as the lift; ``depth`` float32 [H, W] metres, 0 =
    none; ``label`` int32 [H, W], what the lift shows: an object's id, or minus the class; ``leaves`` bool [H, W], the
    pixels of what is removed, and ``beside`` bool [H, W], these and GROWN pixels around them."""

    camera: Camera
    colour: NDArray[np.float32]
    depth: NDArray[np.float32]
    label: NDArray[np.int32]
    leaves: NDArray[np.bool_]

    @property
    def beside(self) -> NDArray[np.bool_]:
        return grown(self.leaves, GROWN)

    def also_without(self, cells: NDArray[np.int32]) -> PlateView:
        """The same view, in which the pixels that show these cells leave as well."""
        more = np.isin(cell_keys(cells_of(self.camera.unproject(self.depth).reshape(-1, 3))), cell_keys(cells))
        return replace(self, leaves=self.leaves | (more.reshape(self.depth.shape) & (self.depth > 0)))


def grown(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """A mask [H, W] grown by a number of pixels."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * by + 1,) * 2, np.uint8)) > 0)


def frames_around(frames: Sequence[Frame], low: NDArray[np.floating], high: NDArray[np.floating]) -> list[Frame]:
    """The frames with depth that look at a box, occluded or not."""
    sides = [np.linspace(*ends, _STEP) for ends in zip(low, high, strict=True)]
    inside = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 3)
    return [frame for frame in frames if frame.read_depth is not None and len(frame.camera.seen(inside)[0])]


def read_views(
    frames: Sequence[Frame], baker: FrameBaker, ids: Collection[int], progress: Callable[[int, int], object]
) -> Iterator[PlateView]:
    """Yields the frames' photos, in which the objects ``ids`` are marked as leaving. Raises PlgsError for a photo that
    cannot be read, and what ``progress`` raises."""
    for done, frame in enumerate(frames):
        progress(done, len(frames))
        size = size_within(frame.size, WITHIN)
        camera, photo = frame.camera.resized(*size), frame.read_colour(size)
        shown = baker.decided(camera, wanted=("combined", "semantic", "instance"))
        label = np.where(shown.instance > 0, shown.instance, -shown.semantic).astype(np.int32)
        colour = photo / np.float32(255) / _gain(photo, colour_picture(shown))
        yield PlateView(camera, colour.clip(0, 1), frame.depth(size), label, np.isin(label, sorted(ids)))
    progress(len(frames), len(frames))


def _gain(photo: NDArray[np.uint8], drawn: NDArray[np.uint8]) -> NDArray[np.float32]:
    """How much brighter a photo is than the lift, by channel, float32 [3]."""
    usable = (np.minimum(photo, drawn) >= DARK).all(axis=2) & (np.maximum(photo, drawn) <= BRIGHT).all(axis=2)
    if usable.sum() < LEAST_COMPARED:
        return np.ones(3, np.float32)
    log_photo, log_drawn = (np.log(each[usable].astype(np.float32)) for each in (photo, drawn))
    ratio = np.exp(np.median(log_photo - log_drawn, axis=0))
    return np.asarray(ratio.clip(1 / LARGEST_GAIN, LARGEST_GAIN), np.float32)
