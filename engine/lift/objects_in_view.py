"""Checks that the finished scene shows every object where its points are, and relabels Gaussians where it does not. A
Gaussian is about as large as a wall plug, and its label is blended from the votes of all pixels that it covers. So a
small object may have points, but no Gaussian with its label."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..model.label_voting import Contributors, pixel_labels
from ..model.settling import OwnedPoints
from ..model.structured import GaussianLabels, LabelChannels, StructuredScene
from ..scene.view import NEAR, NEAR_SHARE

LEAST_SHOWN = 0.5
"""An object is shown too little if a smaller share than this of the pixels at its own points show it."""
LEAST_WEIGHT = 0.2
"""Least blending weight, in a pixel that does not show the object, with which a Gaussian counts as hiding it."""


class ObjectsInView(NamedTuple):
    """Counts, over all views, of pixels where an object's own points lie at the rendered depth: all (``seen``) and
    those that show the object (``shown``); int64 [U], in the order of the channels' ``instance_slots``. ``hiding``
    int64 [2, n]: an object's index, and a Gaussian with a large weight in one of the pixels that do not show it."""

    seen: NDArray[np.int64]
    shown: NDArray[np.int64]
    hiding: NDArray[np.int64]

    @property
    def share(self) -> NDArray[np.float64]:
        """The share of each object's pixels that show it, float64 [U]; 0 for an object that is never seen."""
        return self.shown / np.maximum(self.seen, 1)

    def numbers(self) -> dict[str, float]:
        """Return figures for the log: the number of objects, their mean share, and how many are shown too little."""
        share = self.share
        mean = float(share.mean()) if len(share) else 1.0
        return {"objects": len(share), "mean": mean, "below": int((share < LEAST_SHOWN).sum())}


def objects_in_view(
    scene: StructuredScene, labels: GaussianLabels, views: Iterable[Contributors], points: OwnedPoints
) -> ObjectsInView:
    """Count how often the rendered ``views`` show each object, if the Gaussians have these ``labels``."""
    number = _numbers(scene.channels, points.instance)
    xyz, number = points.xyz[number >= 0], number[number >= 0]
    count, first = len(scene.channels.instance_slots), len(scene.channels.class_ids)
    seen, shown = np.zeros(count, np.int64), np.zeros(count, np.int64)
    hiding = np.zeros(0, np.int64)  # two numbers in one, as `unique` of columns is slow
    for view in views:
        row, pixel, depth = view.camera.seen(xyz)
        x, y = pixel.astype(np.int64).T
        drawn, pixels = view.depth[y, x], view.depth.size
        near = (drawn > 0) & (np.abs(drawn - depth) <= np.maximum(NEAR, NEAR_SHARE * drawn))
        pairs = np.unique((number[row] * pixels + y * view.camera.width + x)[near])  # a pixel counts once for an object
        one, pixel = np.divmod(pairs, pixels)
        is_shown = pixel_labels(scene, labels, view).reshape(-1)[pixel] == first + one
        seen += np.bincount(one, minlength=count)
        shown += np.bincount(one[is_shown], minlength=count)
        weight, gaussian = (each.reshape(pixels, -1)[pixel[~is_shown]] for each in (view.weight, view.gaussian))
        pixel_of, place = np.nonzero(weight >= LEAST_WEIGHT)
        found = one[~is_shown][pixel_of] << 32 | gaussian[pixel_of, place]
        hiding = np.unique(np.concatenate([hiding, found]))
    return ObjectsInView(seen, shown, np.stack([hiding >> 32, hiding & 0xFFFFFFFF]))


def with_hidden_objects(scene: StructuredScene, labels: GaussianLabels, found: ObjectsInView) -> GaussianLabels:
    """Return the labels, in which objects shown too little take over the Gaussians that hide their points."""
    label, share = labels.label.numpy().copy(), labels.share.numpy().copy()
    numbers, rows = found.hiding[:, found.share[found.hiding[0]] < LEAST_SHOWN]
    share[rows] = 0
    label[rows, 0], share[rows, 0] = len(scene.channels.class_ids) + numbers, 1
    return GaussianLabels(torch.from_numpy(label), torch.from_numpy(share))


def _numbers(channels: LabelChannels, instance: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the index of each instance id [N] in the channels' ``instance_slots``, int64 [N], -1 if absent."""
    ids = [channels.slot_ids[slot] for slot in channels.instance_slots]
    table = np.full(max([*ids, int(instance.max(initial=0))], default=0) + 1, -1, np.int64)
    table[ids] = np.arange(len(ids))
    return table[instance]
