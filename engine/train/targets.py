"""The targets of each training view."""

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
    """Targets of one training view at lift size. ``photo`` is sRGB-encoded, in [0, 1], with its moments for SSIM; on a
    device it is uint8 [H, W, 3]. ``projected`` int16 [H, W]: semantic channel of the projected point cloud, -1 = none.
    ``matched`` int16 [H, W]: instance slot of M_match, -1 = none. ``things`` are the thing segments of the input mask.
    ``pseudo`` int16 [H, W]: semantic channel of the pseudo labels, None before the self-training stage; ``pseudo_slot``
    int16 [H, W]: the slots, if segments were given objects as well; they then replace ``matched``. ``depth`` float32
    [H, W] is the sensor's, metres (0 = none); ``border`` bool [H, W], or None, where the photo shows only a black
    border; ``weight`` how much the photo counts compared with sharper ones; ``gain`` float32 [3], or None, its exposure
    relative to the room's. ``columns``: the label channels in which the view is compared, if they are kept."""

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
    """Labels of any shape as channel numbers of this ``dtype``: the index of each in ``ids`` (all >= 0), -1 for 0 and
    for labels that are not in ``ids``."""
    table = np.full(max(int(labels.max(initial=0)), max(ids, default=0)) + 1, -1, dtype)
    for column, label in enumerate(ids):
        if label:
            table[label] = column
    return torch.from_numpy(table[np.maximum(labels, 0)])  # entry 0 is -1, no channel


def slots_of(instances: NDArray[np.integer], known: NDArray[np.bool_], channels: LabelChannels) -> torch.Tensor:
    """Instance ids (0 = none) as slots, int16: "no object" for 0 where objects are ``known``, otherwise -1."""
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
    """Targets of ``view`` from class ids and instance ids, int32 [H, W] each. Where there is a class, instance 0 means
    no object, which is a target if ``teach_no_object``. Without instance ids, objects are unknown."""
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
