"""Self-training: makes pseudo labels, for which each region of an input mask takes the label rendered in most of its
pixels (the paper's section "Self-training with Consistency-enhanced Segments")."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace

import numpy as np
import torch

from ..instances.panoptic_labels import UNKNOWN_LABEL, PanopticLabels
from ..instances.segment_votes import segment_labels
from ..model.baking import decided_labels
from ..model.neural_gaussians import PanopticRendering
from ..model.structured import LabelChannels
from ..scene import VOID, PanopticMask
from ..semantics.consistency import pseudo_labels
from .targets import ViewTargets, columns_of, slots_of


def pseudo_label_steps(every: float, steps: int) -> frozenset[int]:
    """Return after which steps pseudo labels are made: multiples of the share ``every`` of ``steps`` but the last."""
    points = (round(number * every * steps) for number in range(1, math.ceil(1 / every)))
    return frozenset(point for point in points if 0 < point < steps)


@dataclass(frozen=True)
class PseudoLabels:
    """The pseudo labels of one view, compressed by zlib to about a hundredth. ``classes``: the semantic channel of each
    pixel, int16 of ``shape`` (H, W), -1 = none; ``slots``: the instance slot, None if regions got only classes."""

    shape: tuple[int, int]
    classes: bytes
    slots: bytes | None

    @classmethod
    def of(
        cls,
        classes: torch.Tensor,  # [H, W]
        slots: torch.Tensor | None,  # [H, W]
    ) -> PseudoLabels:
        """Compress the semantic channels and instance slots of one view's pixels, both integers [H, W], -1 = none."""
        height, width = classes.shape
        return cls((height, width), _packed(classes), None if slots is None else _packed(slots))

    def teach(self, target: ViewTargets) -> ViewTargets:
        """Return ``target`` with these pseudo labels, decompressed to int16 [H, W], as its labels to train on."""
        classes, slots = (
            # frombuffer warns about bytes, which are read-only
            None if packed is None else torch.frombuffer(bytearray(zlib.decompress(packed)), dtype=torch.int16)
            for packed in (self.classes, self.slots)
        )
        assert classes is not None
        slots = None if slots is None else slots.view(self.shape)
        return replace(target, pseudo=classes.view(self.shape), pseudo_slot=slots)


def _packed(labels: torch.Tensor) -> bytes:
    return zlib.compress(labels.to(torch.int16).contiguous().numpy().tobytes(), 1)  # level 1 packs regions well enough


def rendered_labels(
    mask: PanopticMask, rendering: PanopticRendering, channels: LabelChannels, least_region: int
) -> PseudoLabels:
    """Make a view's pseudo labels. As in the paper, a region of at least ``least_region`` pixels takes the class that
    most of its pixels are rendered with. If each object has a single class, segments take class and object instead.
    Pixels where nothing is rendered do not vote."""
    if not channels.class_of_slot:
        class_ids = np.array(channels.class_ids, np.int32)
        coverage = rendering.class_coverage
        rendered = np.where(coverage.any(axis=2), class_ids[coverage.argmax(axis=2)], VOID).astype(np.int32)
        return PseudoLabels.of(columns_of(pseudo_labels(mask, rendered, least_region), channels.class_ids), None)
    things = frozenset(channels.class_of_slot) - {VOID}
    covered = np.concatenate([rendering.class_coverage, rendering.instance_coverage], axis=2)
    class_id, instance = decided_labels(covered.reshape(-1, covered.shape[2]), channels, things)
    # The instances are numbered 1.. in the order of their slots.
    labels = PanopticLabels(channels.class_ids, tuple(channels.class_of_slot[slot] for slot in channels.instance_slots))
    label = labels.of_points(class_id, instance).reshape(rendering.alpha.shape)
    label[rendering.alpha <= 0] = UNKNOWN_LABEL
    agreed = segment_labels(mask, label, len(labels))
    classes, instances = labels.classes(agreed), labels.objects(agreed)
    return PseudoLabels.of(columns_of(classes, channels.class_ids), slots_of(instances, classes != VOID, channels))
