"""The photos around removed objects, and what the lift shows in the same views."""

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
from ..scene.exposure import exposure_beside
from ..scene.view import border_mask

WITHIN = (800, 800)
"""Photos are read at most this large."""
GROWN = 2
"""Pixels by which an object's outline and a photo's black border are grown: their rims are not trusted."""
_STEP = 8  # points along each side of a box: a frame sees the box if it sees one of its points


@dataclass(frozen=True, eq=False)
class PlateView:
    """A photo near removed objects: ``colour`` float32 [H, W, 3] sRGB in [0, 1], as bright as the lift; ``depth``
    float32 [H, W] metres, 0 = none; ``label`` int32 [H, W], what the lift shows: an object's id, or minus the class;
    ``leaves`` bool [H, W], the pixels of what is removed, and ``beside`` bool [H, W], these and GROWN pixels around."""

    camera: Camera
    colour: NDArray[np.float32]
    depth: NDArray[np.float32]
    label: NDArray[np.int32]
    leaves: NDArray[np.bool_]

    @property
    def beside(self) -> NDArray[np.bool_]:
        return grown(self.leaves, GROWN)

    def also_without(self, cells: NDArray[np.int32]) -> PlateView:
        """Return the same view with the pixels that show these ``cells`` [N, 3] marked as leaving, too."""
        more = np.isin(cell_keys(cells_of(self.camera.unproject(self.depth).reshape(-1, 3))), cell_keys(cells))
        return replace(self, leaves=self.leaves | (more.reshape(self.depth.shape) & (self.depth > 0)))


def grown(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Return a mask [H, W] enlarged on all sides by a number of pixels."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * by + 1,) * 2, np.uint8)) > 0)


def frames_around(frames: Sequence[Frame], xyz: NDArray[np.floating]) -> list[Frame]:
    """Return the frames with depth whose picture shows a point of ``xyz`` [N, 3] or of their box, hidden or not."""
    sides = [np.linspace(*ends, _STEP) for ends in zip(xyz.min(axis=0), xyz.max(axis=0), strict=True)]
    shown = np.concatenate([xyz, np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 3)])
    return [frame for frame in frames if frame.read_depth is not None and len(frame.camera.seen(shown)[0])]


def read_views(
    frames: Sequence[Frame], baker: FrameBaker, ids: Collection[int], progress: Callable[[int, int], object]
) -> Iterator[PlateView]:
    """Yield the frames' photos, in which the objects ``ids`` are marked as leaving. Raises PlgsError for a photo that
    cannot be read, and what ``progress`` raises."""
    for done, frame in enumerate(frames):
        progress(done, len(frames))
        size = size_within(frame.size, WITHIN)
        camera, photo = frame.camera.resized(*size), frame.read_colour(size)
        shown = baker.decided(camera, wanted=("combined", "semantic", "instance"))
        label = np.where(shown.instance > 0, shown.instance, -shown.semantic).astype(np.int32)
        brightness = 255 * exposure_beside(photo.reshape(-1, 3), colour_picture(shown).reshape(-1, 3))
        colour = (photo / brightness).clip(0, 1).astype(np.float32)
        depth = np.where(grown(border_mask(photo), GROWN), np.float32(0), frame.depth(size))
        yield PlateView(camera, colour, depth, label, np.isin(label, sorted(ids)))
    progress(len(frames), len(frames))
