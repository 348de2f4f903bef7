"""What each training view is supervised with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..model.structured import NO_OBJECT, LabelChannels
from ..scene import Camera, View
from .assignment import ThingSegments
from .similarity import PhotoMoments


@dataclass
class ViewTargets:
    """Targets of one training view at lift size.

    ``photo`` is sRGB-encoded, in [0, 1], with what SSIM needs of it. ``projected`` int16 [H, W]: semantic channel of
    the projected point cloud, -1 where it says nothing. ``matched`` int16 [H, W]: instance slot of M_match, -1 = none.
    ``things`` are the machine's thing segments in this view. ``pseudo`` int16 [H, W]: semantic channel of the pseudo
    labels, None before the self-training stage; ``pseudo_slot`` int16 [H, W] with it where segments were given objects
    as well, which then takes the place of ``matched``.

    ``depth`` float32 [H, W] is the sensor's, metres (0 = none); ``border`` bool [H, W], or None, where the photo shows
    nothing but a black border; ``weight`` how much the photo counts beside sharper ones; ``gain`` float32 [3], or None,
    its exposure against the room's. ``segments``: all of the machine's, where their consistency counts.
    """

    name: str
    camera: Camera
    photo: PhotoMoments
    projected: torch.Tensor
    matched: torch.Tensor
    things: ThingSegments
    depth: torch.Tensor
    border: torch.Tensor | None = None
    weight: float = 1.0
    gain: torch.Tensor | None = None
    segments: ThingSegments | None = None
    pseudo: torch.Tensor | None = None
    pseudo_slot: torch.Tensor | None = None

    @property
    def semantic(self) -> torch.Tensor:
        return self.projected if self.pseudo is None else self.pseudo

    @property
    def slot(self) -> torch.Tensor:
        return self.matched if self.pseudo_slot is None else self.pseudo_slot


def columns_of(labels: NDArray[np.integer], ids: tuple[int, ...]) -> torch.Tensor:
    """Labels of any shape as channel numbers, int64: its place in ``ids`` (all >= 0), -1 for those not in it and for
    0."""
    table = np.full(max(int(labels.max(initial=0)), max(ids, default=0)) + 1, -1, np.int64)
    for column, label in enumerate(ids):
        if label:
            table[label] = column
    return torch.from_numpy(table[np.maximum(labels, 0)])


def slots_of(instances: NDArray[np.integer], known: NDArray[np.bool_], channels: LabelChannels) -> torch.Tensor:
    """Instance ids of any shape (0 = none) as slots, int16: "no object" where none is ``known`` to be, -1 where
    nothing is known."""
    instance_ids = tuple(max(slot, 0) for slot in channels.slot_ids)
    slots = columns_of(instances, instance_ids)
    alone = torch.from_numpy(known & (instances == 0))
    return torch.where(alone, channels.slot_ids.index(NO_OBJECT), slots).to(torch.int16)


def view_targets(
    view: View,
    channels: LabelChannels,
    *,
    projected_class: NDArray[np.int32],
    matched_instance: NDArray[np.int32] | None,
    with_segments: bool = False,
    weight: float = 1.0,
    gain: NDArray[np.float64] | None = None,
) -> ViewTargets:
    """Targets of ``view`` from class ids and instance ids, int32 [H, W] each. Where a class is known (not 0), instance
    0 is no object; without instance ids nothing is known of objects."""
    matched = torch.full(projected_class.shape, -1, dtype=torch.int16)
    if matched_instance is not None:
        matched = slots_of(matched_instance, projected_class != 0, channels)
    things = {segment.id for segment in view.mask.segments if segment.is_thing}
    is_thing = np.isin(view.mask.ids, sorted(things))
    return ViewTargets(
        name=view.name,
        camera=view.camera,
        photo=PhotoMoments.of(torch.from_numpy(view.colour.astype(np.float32) / 255.0)),
        projected=columns_of(projected_class, channels.class_ids).to(torch.int16),
        matched=matched,
        things=ThingSegments.of(np.where(is_thing, view.mask.ids, 0)),
        depth=torch.from_numpy(view.depth if view.border is None else np.where(view.border, np.float32(0), view.depth)),
        border=None if view.border is None else torch.from_numpy(view.border),
        weight=weight,
        segments=ThingSegments.of(view.mask.ids) if with_segments else None,
        gain=None if gain is None else torch.from_numpy(gain).float(),
    )
