"""Predicted views as COCO panoptic: a PNG a view and one JSON file."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import write_atomically
from ..scene import VOID, ClassTable
from .previews import png_bytes

MOST_IDS = 4096
"""Class and instance ids below this fit into one 24-bit colour."""


def write_coco(
    folder: Path,
    classes: ClassTable,
    views: Iterable[tuple[str, NDArray[np.int32], NDArray[np.int32]]],
) -> None:
    """Write ``panoptic.json`` and ``panoptic/<frame>.png`` into ``folder``.

    ``views``: frame name, class ids and instance ids, int32 [H, W] each. A segment's id is class * 4096 +
    instance: unlike a detector's, it means the same object in every view. Raises ValueError for ids of 4096
    or more, OSError.
    """
    images, annotations = [], []
    for number, (name, semantic, instance) in enumerate(views, start=1):
        if max(int(semantic.max(initial=0)), int(instance.max(initial=0))) >= MOST_IDS:
            raise ValueError(f"{name}: class and instance ids must be below {MOST_IDS} for COCO panoptic")
        ids = np.where(semantic == VOID, 0, semantic * MOST_IDS + instance)
        colours = np.stack([ids & 255, ids >> 8 & 255, ids >> 16 & 255], axis=-1).astype(np.uint8)
        write_atomically(folder / "panoptic" / f"{name}.png", png_bytes(colours))
        height, width = ids.shape
        images.append({"id": number, "file_name": f"{name}.png", "width": width, "height": height})
        segments = _segments(ids)
        annotations.append({"image_id": number, "file_name": f"{name}.png", "segments_info": segments})
    categories = [
        {"id": c.id, "name": c.name, "isthing": int(c.is_thing), "color": list(c.colour)} for c in classes.categories
    ]
    content = {"images": images, "annotations": annotations, "categories": categories}
    write_atomically(folder / "panoptic.json", json.dumps(content, ensure_ascii=False) + "\n")


def _segments(ids: NDArray[np.int32]) -> list[dict[str, object]]:
    """The segments of one view in ascending order of id, with area and bounding box (x, y, width, height)."""
    segments: list[dict[str, object]] = []
    for segment in np.unique(ids[ids > 0]).tolist():
        rows, columns = np.nonzero(ids == segment)
        left, top = int(columns.min()), int(rows.min())
        box = [left, top, int(columns.max()) - left + 1, int(rows.max()) - top + 1]
        category = segment // MOST_IDS
        segments.append({"id": segment, "category_id": category, "area": len(rows), "bbox": box, "iscrowd": 0})
    return segments
