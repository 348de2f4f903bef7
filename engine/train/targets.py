"""What each training view is compared with: its photo, depth and labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray

from ..model.structured import NO_OBJECT, LabelChannels
from ..scene import Camera, View
from .label_losses import ThingSegments
from .similarity import PhotoMoments


@dataclass
class ViewTargets:
    """What the rendering of one training view is compared with; arrays are [H, W] unless said otherwise. ``photo``:
    sRGB in [0, 1] with its moments for SSIM, on a device uint8 [H, W, 3]. ``projected`` int16: the semantic channel of
    the projected point cloud, -1 = none. ``matched`` int16: the instance slot of M_match, -1 = none. ``things``: the
    thing segments of the input mask. ``depth`` float32: the sensor's, metres, 0 = none. ``border`` bool or None: where
    the photo has only a black border. ``weight``: how much the photo counts, less if blurred. ``gain`` float32 [3] or
    None: its exposure relative to the other photos'. ``pseudo`` int16: the semantic channel of the pseudo labels, None
    before self-training; ``pseudo_slot`` int16: their slots, if they have any, which then replace ``matched``.
    ``columns``: the label channels that are compared in this view, cached."""

    name: str
    camera: Camera
    photo: PhotoMoments | torch.Tensor
    projected: torch.Tensor
    matched: torch.Tensor
    things: ThingSegments
    depth: torch.Tensor
    border: torch.Tensor | None = None
    weight: float = 1.0
    gain: torch.Tensor | None = None
    pseudo: torch.Tensor | None = None
    pseudo_slot: torch.Tensor | None = None
    columns: NDArray[np.int64] | None = None

    @property
    def semantic(self) -> torch.Tensor:
        return self.projected if self.pseudo is None else self.pseudo

    @property
    def slot(self) -> torch.Tensor:
        return self.matched if self.pseudo_slot is None else self.pseudo_slot


def columns_of(labels: NDArray[np.integer], ids: tuple[int, ...], dtype: DTypeLike = np.int64) -> torch.Tensor:
    """Return the index of each label in ``ids`` (all >= 0), as a tensor of the labels' shape, with this ``dtype``: -1
    for label 0 and for labels that are not in ``ids``."""
    table = np.full(max(int(labels.max(initial=0)), max(ids, default=0)) + 1, -1, dtype)
    for column, label in enumerate(ids):
        if label:
            table[label] = column
    return torch.from_numpy(table[np.maximum(labels, 0)])  # entry 0 is -1, no channel


def slots_of(instances: NDArray[np.integer], known: NDArray[np.bool_], channels: LabelChannels) -> torch.Tensor:
    """Return the slot of each instance id, int16. Id 0 gives the slot of "no object" where ``known``, otherwise -1."""
    slots = columns_of(instances, tuple(max(slot, 0) for slot in channels.slot_ids), np.int16)
    return slots.masked_fill_(torch.from_numpy(known & (instances == 0)), channels.slot_ids.index(NO_OBJECT))


def view_targets(
    view: View,
    channels: LabelChannels,
    *,
    projected_class: NDArray[np.int32],
    matched_instance: NDArray[np.int32] | None,
    teach_no_object: bool = True,
    weight: float = 1.0,
    gain: NDArray[np.float64] | None = None,
) -> ViewTargets:
    """Make the targets of ``view`` from the class and instance ids of its pixels, int32 [H, W]. Instance 0 means "no
    object" where there is a class, and is trained if ``teach_no_object``. ``matched_instance`` None: none is known.
    ``weight`` and ``gain`` are as in ViewTargets."""
    matched = torch.full(projected_class.shape, -1, dtype=torch.int16)
    if matched_instance is not None:
        matched = slots_of(matched_instance, (projected_class != 0) & teach_no_object, channels)
    things = {segment.id for segment in view.mask.segments if segment.is_thing}
    is_thing = np.isin(view.mask.ids, sorted(things))
    return ViewTargets(
        name=view.name,
        camera=view.camera,
        photo=PhotoMoments.of(torch.from_numpy(view.colour.astype(np.float32) / 255.0)),
        projected=columns_of(projected_class, channels.class_ids, np.int16),
        matched=matched,
        things=ThingSegments.of(np.where(is_thing, view.mask.ids, 0)),
        depth=torch.from_numpy(view.depth if view.border is None else np.where(view.border, np.float32(0), view.depth)),
        border=None if view.border is None else torch.from_numpy(view.border),
        weight=weight,
        gain=None if gain is None else torch.from_numpy(gain).float(),
    )
