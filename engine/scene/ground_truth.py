"""Ground truth for the metrics: never read by the lift itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import PlgsError
from .class_tables import REDUCED, known_table
from .classes import ClassTable
from .frame import GroundTruth, Size
from .image_header import check_image_file
from .label_image import check_label_header
from .layout import files_by_stem, natural_order, same_shape, shown_size
from .pixels import decode_single_channel, distinct_ids, resize_nearest

_FIX = "Correct it, or take the ground truth away: only the metrics need it."


@dataclass(frozen=True)
class GroundTruthReader:
    """Reads one frame's ground truth. Class ids that the masks' table does not have become void."""

    semantic: Path
    instance: Path
    class_ids: frozenset[int]

    def __call__(self, size: Size | None = None) -> GroundTruth:
        """Ground truth at ``size`` (width, height) or its own. Raises PlgsError when a file is bad."""
        stored = read_label_pair(self.semantic, self.instance)
        known = np.zeros(int(stored.semantic.max(initial=0)) + 1, np.int32)
        for class_id in self.class_ids:
            if class_id < len(known):
                known[class_id] = class_id
        semantic, instance = known[stored.semantic], stored.instance
        if size is not None:
            semantic, instance = resize_nearest(semantic, size), resize_nearest(instance, size)
        return GroundTruth(semantic, instance)

    def unknown_ids(self) -> frozenset[int]:
        """Class ids in the file, void aside, that the masks' table does not have. Raises PlgsError for a bad file."""
        check_image_file(self.instance)
        found, _ = distinct_ids(decode_single_channel(self.semantic))
        return frozenset(found.tolist()) - self.class_ids - {0}


def read_label_pair(semantic: Path, instance: Path) -> GroundTruth:
    """Class ids and instance ids out of two label images. Raises PlgsError when a file is bad."""
    stored = GroundTruth(decode_single_channel(semantic), decode_single_channel(instance))
    if stored.semantic.shape != stored.instance.shape:
        raise PlgsError("classes and instances differ in size", instance, "Make both of one size.")
    return stored


def open_ground_truth(
    scene: Path, sizes: Mapping[str, Size], classes: ClassTable
) -> tuple[dict[str, GroundTruthReader], list[str]]:
    """Ground truth in ``rs_semantics`` and ``rs_instance``, or ``gt/semantic*`` and ``gt/instance``; headers only.

    The result has a reader for each frame with ground truth, and warnings. ``sizes`` are those of the colour images by
    frame, class ids those of the masks' table. Raises PlgsError when an image is no label image or has another shape.
    """
    folders = _find_folders(scene)
    if folders is None:
        return {}, []
    semantics = files_by_stem(folders[0], {".png"}, _FIX)
    instances = files_by_stem(folders[1], {".png"}, _FIX)
    readers: dict[str, GroundTruthReader] = {}
    for name, size in sizes.items():
        if name in semantics and name in instances:
            readers[name] = GroundTruthReader(semantics[name], instances[name], frozenset(classes.ids))
            for path in (semantics[name], instances[name]):
                own = check_label_header(path)
                if not same_shape(own, size):
                    what = f"ground truth of {shown_size(own)} does not fit the colour of {shown_size(size)}"
                    raise PlgsError(what, path, _FIX)
    return readers, _warnings(folders[0], list(sizes), readers, classes)


def _find_folders(scene: Path) -> tuple[Path, Path] | None:
    """The folders of classes and of instances; None when either is missing."""
    if (scene / "rs_semantics").is_dir() and (scene / "rs_instance").is_dir():
        return scene / "rs_semantics", scene / "rs_instance"
    found = [path for path in (scene / "gt").glob("semantic*") if path.is_dir()]
    if found and (scene / "gt" / "instance").is_dir():
        return min(found, key=lambda path: natural_order(path.name)), scene / "gt" / "instance"
    return None


def _warnings(
    folder: Path, names: Sequence[str], readers: Mapping[str, GroundTruthReader], classes: ClassTable
) -> list[str]:
    warnings = []
    if len(readers) < len(names):
        warnings.append(f"{len(names) - len(readers)} of {len(names)} frames have no ground truth in {folder.name}")
    if folder.name == "rs_semantics" and {(c.id, c.name) for c in classes.categories} != {
        (label.id, label.name) for label in known_table(REDUCED).labels
    }:
        warnings.append(
            "rs_semantics is in Panoptic Lifting's class table and the masks have one of their own: the metrics "
            "compare ids, so they only mean something where both agree"
        )
    return warnings
