"""Panoptic Lifting's machine masks: folders ``<prefix>_semantics`` and ``<prefix>_instance`` of label images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .classes import Category, ClassTable, distinct_colour
from .frame import PanopticMask, SceneError, Segment, Size
from .image_header import read_image_header
from .layout import files_by_stem, listed, require_all, shown_size
from .mask_set import READ_FIX, MaskSet
from .pixels import decode_single_channel, distinct_ids, resize_nearest

_NAMES = (
    "wall floor cabinet bed chair sofa table door window counter shelves curtain ceiling refrigerator television "
    "person toilet sink lamp bag otherprop"
).split()
_THINGS = frozenset({4, 5, 6, 14, 15, 16, 17, 18, 20})

REDUCED_CLASSES = ClassTable(
    tuple(
        Category(class_id, name, class_id in _THINGS, distinct_colour(class_id))
        for class_id, name in enumerate(_NAMES, start=1)
    )
)
"""The 21 classes (and void) that Panoptic Lifting and the paper evaluate on; tables and lamps are stuff."""


@dataclass(frozen=True)
class PanopticLiftingMaskReader:
    """Reads one frame's mask: every pair of a class and an instance that occurs is a segment, numbered from 1.

    A region of a thing class without an instance (0) keeps its class but is no thing: it may be several objects.
    """

    semantic: Path
    instance: Path

    def __call__(self, size: Size | None = None) -> PanopticMask:
        """The mask at ``size`` (width, height) or its own. Raises SceneError for a class outside the table."""
        classes, instances = decode_single_channel(self.semantic), decode_single_channel(self.instance)
        unknown = sorted({*distinct_ids(classes)[0].tolist()} - {0} - {*REDUCED_CLASSES.ids})
        if unknown:
            raise SceneError(
                f"class ids {listed(unknown)} are not in Panoptic Lifting's reduced table (0 to 21)",
                self.semantic,
                "Make the masks with the reduced classes, or give COCO panoptic masks with a table of your own.",
            )
        if classes.shape != instances.shape:
            raise SceneError("the instance image has another size", self.instance, "Make it as large as the classes.")
        # Instances have at most 16 bits in a PNG.
        pairs = classes << 16 | instances
        number = np.zeros(int(pairs.max(initial=0)) + 1, np.int32)
        segments: list[Segment] = []
        for pair in distinct_ids(pairs)[0].tolist():
            class_id, instance_id = pair >> 16, pair & 0xFFFF
            if class_id != 0:
                number[pair] = len(segments) + 1
                group = class_id in _THINGS and instance_id == 0
                segments.append(
                    Segment(len(segments) + 1, class_id, class_id in _THINGS and not group, is_group=group)
                )
        mask = number[pairs]
        return PanopticMask(resize_nearest(mask, size) if size else mask, tuple(segments))


def open_panoptic_lifting_masks(semantics: Path, names: Sequence[str]) -> MaskSet:
    """Open ``<prefix>_semantics`` and the ``<prefix>_instance`` beside it; headers only. Raises SceneError."""
    instances = semantics.with_name(semantics.name.removesuffix("_semantics") + "_instance")
    semantic_files = files_by_stem(semantics, {".png"}, READ_FIX)
    instance_files = files_by_stem(instances, {".png"}, f"Panoptic Lifting writes it beside {semantics.name}.")
    require_all(names, semantic_files, "mask", semantics, "Add PNGs named like the colour images.")
    require_all(names, instance_files, "mask", instances, "Add PNGs named like the colour images.")
    readers = {name: PanopticLiftingMaskReader(semantic_files[name], instance_files[name]) for name in names}
    sizes: dict[str, Size] = {}
    for name in names:
        sizes[name] = check_label_header(semantic_files[name])
        if check_label_header(instance_files[name]) != sizes[name]:
            raise SceneError(
                f"the instance image is not {shown_size(sizes[name])} as the classes are",
                instance_files[name],
                "Make both with the same size.",
            )
    return MaskSet(REDUCED_CLASSES, readers, sizes, {name: semantic_files[name] for name in names})


def check_label_header(path: Path) -> Size:
    """The size of a label image (width, height). Raises SceneError unless it has one channel of 8 or 16 bits."""
    header = read_image_header(path)
    if header.format != "png" or header.channels != 1 or header.palette or header.bit_depth < 8:
        raise SceneError(
            "a label image must be a PNG with one channel of 8 or 16 bits, without a palette",
            path,
            "Save the ids themselves as grey values.",
        )
    return header.size
