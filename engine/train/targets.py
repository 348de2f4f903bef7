"""What each training view is supervised with."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..model.structured import NO_OBJECT, LabelChannels
from ..scene import Camera, View
from .assignment import ThingSegments
from .similarity import PhotoMoments


@dataclass(frozen=True)
class PseudoLabels:
    """What self-training says of one view's pixels, packed: regions of a label compress to a hundredth.

    ``classes``: bytes of semantic channels int16 [H, W], -1 = nothing; ``slots`` of instance slots with them, or None
    where segments were given no objects.
    """

    shape: tuple[int, int]
    classes: bytes
    slots: bytes | None

    @classmethod
    def of(cls, classes: torch.Tensor, slots: torch.Tensor | None) -> PseudoLabels:
        """Of channel numbers and slots, [H, W] each."""
        height, width = classes.shape
        return cls((height, width), _packed(classes), None if slots is None else _packed(slots))

    def unpacked(self) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Classes and slots, int16 [H, W] each."""
        classes, slots = (
            None if packed is None else torch.frombuffer(bytearray(zlib.decompress(packed)), dtype=torch.int16)
            for packed in (self.classes, self.slots)
        )
        assert classes is not None
        return classes.view(self.shape), None if slots is None else slots.view(self.shape)


def _packed(labels: torch.Tensor) -> bytes:
    return zlib.compress(labels.to(torch.int16).contiguous().numpy().tobytes(), 1)


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

    def taught(self, labels: PseudoLabels) -> ViewTargets:
        """With these pseudo labels."""
        pseudo, pseudo_slot = labels.unpacked()
        return replace(self, pseudo=pseudo, pseudo_slot=pseudo_slot)

    @property
    def semantic(self) -> torch.Tensor:
        return self.projected if self.pseudo is None else self.pseudo

    @property
    def slot(self) -> torch.Tensor:
        return self.matched if self.pseudo_slot is None else self.pseudo_slot


def columns_of(labels: NDArray[np.integer], ids: tuple[int, ...]) -> torch.Tensor:
    """Labels of any shape as channel numbers, int64: its place in ``ids`` (all >= 0), -1 for those not in it and for
    0."""
    return torch.from_numpy(_places(labels, ids, np.dtype(np.int64)))


def _places(labels: NDArray[np.integer], ids: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """``columns_of`` as an array."""
    table = np.full(max(int(labels.max(initial=0)), max(ids, default=0)) + 1, -1, dtype)
    for column, label in enumerate(ids):
        if label:
            table[label] = column
    return table[np.maximum(labels, 0)]


def slots_of(instances: NDArray[np.integer], known: NDArray[np.bool_], channels: LabelChannels) -> torch.Tensor:
    """Instance ids of any shape (0 = none) as slots, int16: "no object" where none is ``known`` to be, -1 where
    nothing is known."""
    instance_ids = tuple(max(slot, 0) for slot in channels.slot_ids)
    slots = _places(instances, instance_ids, np.dtype(np.int16))
    slots[known & (instances == 0)] = channels.slot_ids.index(NO_OBJECT)
    return torch.from_numpy(slots)


def view_targets(
    view: View,
    channels: LabelChannels,
    *,
    projected_class: NDArray[np.int32],
    matched_instance: NDArray[np.int32] | None,
    known: NDArray[np.bool_] | None = None,
    with_segments: bool = False,
    weight: float = 1.0,
    gain: NDArray[np.float64] | None = None,
) -> ViewTargets:
    """Targets of ``view`` from class ids and instance ids, int32 [H, W] each. Where ``known`` bool [H, W] (by
    default where there is a class), instance 0 is no object; without instance ids nothing is known of objects."""
    matched = torch.full(projected_class.shape, -1, dtype=torch.int16)
    if matched_instance is not None:
        matched = slots_of(matched_instance, projected_class != 0 if known is None else known, channels)
    things = {segment.id for segment in view.mask.segments if segment.is_thing}
    is_thing = np.isin(view.mask.ids, sorted(things))
    return ViewTargets(
        name=view.name,
        camera=view.camera,
        photo=PhotoMoments.of(torch.from_numpy(view.colour.astype(np.float32) / 255.0)),
        projected=torch.from_numpy(_places(projected_class, channels.class_ids, np.dtype(np.int16))),
        matched=matched,
        things=ThingSegments.of(np.where(is_thing, view.mask.ids, 0)),
        depth=torch.from_numpy(view.depth if view.border is None else np.where(view.border, np.float32(0), view.depth)),
        border=None if view.border is None else torch.from_numpy(view.border),
        weight=weight,
        segments=ThingSegments.of(view.mask.ids) if with_segments else None,
        gain=None if gain is None else torch.from_numpy(gain).float(),
    )
