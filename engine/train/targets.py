"""What each training view is supervised with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..model.structured import LabelChannels
from ..scene import Camera, View
from .assignment import ThingSegments
from .similarity import PhotoMoments


@dataclass
class ViewTargets:
    """Targets of one training view at lift size.

    ``photo`` is sRGB-encoded, in [0, 1], with what SSIM needs of it. ``projected`` int16 [H, W]: semantic channel of
    the projected point cloud, -1 where it says nothing. ``matched`` int16 [H, W]: instance slot of M_match, -1 = none.
    ``things`` are the machine's thing segments in this view. ``pseudo`` int16 [H, W]: semantic channel of the pseudo
    labels, None before the self-training stage.
    """

    name: str
    camera: Camera
    photo: PhotoMoments
    projected: torch.Tensor
    matched: torch.Tensor
    things: ThingSegments
    pseudo: torch.Tensor | None = None

    @property
    def semantic(self) -> torch.Tensor:
        return self.projected if self.pseudo is None else self.pseudo


def columns_of(labels: NDArray[np.integer], ids: tuple[int, ...]) -> torch.Tensor:
    """Labels of any shape as channel numbers, int64: its place in ``ids``, -1 for those not in it and for 0."""
    table = np.full(max(int(labels.max(initial=0)), max(ids, default=0)) + 1, -1, np.int64)
    for column, label in enumerate(ids):
        if label:
            table[label] = column
    return torch.from_numpy(table[np.maximum(labels, 0)])


def view_targets(
    view: View,
    channels: LabelChannels,
    *,
    projected_class: NDArray[np.int32],
    matched_instance: NDArray[np.int32],
) -> ViewTargets:
    """Targets of ``view`` from class ids and instance ids, int32 [H, W] each, 0 = nothing known."""
    things = {segment.id for segment in view.mask.segments if segment.is_thing}
    is_thing = np.isin(view.mask.ids, sorted(things))
    return ViewTargets(
        name=view.name,
        camera=view.camera,
        photo=PhotoMoments.of(torch.from_numpy(view.colour.astype(np.float32) / 255.0)),
        projected=columns_of(projected_class, channels.class_ids).to(torch.int16),
        matched=columns_of(matched_instance, channels.slot_ids).to(torch.int16),
        things=ThingSegments.of(np.where(is_thing, view.mask.ids, 0)),
    )
