"""Two folders of label images, one of classes and one of instances; or one of classes alone, as palette or grey PNGs.

The values are the class's number in a table that the user names (``--classes``, ``classes.toml``). 0, 255 and 65535
mean nothing where the table does not have them. Instance 0 is none: such a region may be several objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..frame import SceneError, Size
from ..layout import files_by_stem, require_all, shown_size
from .label_map import SUFFIXES, label_map_size, read_label_map
from .painting import segments_of_labels, segments_of_pairs
from .source import IGNORED, FoundMask, MaskSource

PAIRS = (
    ("semantic", "instance"),
    ("semantics", "instances"),
    ("semantic_class", "semantic_instance"),
    ("class", "instance"),
    ("classes", "instances"),
    ("label-filt", "instance-filt"),
    ("label", "instance"),
)
"""Names of the folders of classes and of instances."""
LOOKS_FOR_PAIRS = "folders semantic and instance (or class, label-filt, semantic_class and theirs)"
LOOKS_FOR_PALETTE = "<frame>.png with a palette, or grey, whose values are classes"
_FIX = "Give a label image for every frame, with the frame's name."


@dataclass(frozen=True)
class PairReader:
    """Reads one frame's classes and, where there are any, instances."""

    classes: Path
    instances: Path | None

    def __call__(self) -> FoundMask:
        """The mask. Raises SceneError for a bad file."""
        labels = read_label_map(self.classes)
        if self.instances is None:
            return segments_of_labels(labels)
        instances = read_label_map(self.instances)
        if labels.shape != instances.shape:
            raise SceneError("the instance image has another size", self.instances, "Make it as large as the classes.")
        return segments_of_pairs(labels, instances)


def recognises_pairs(place: Path) -> bool:
    return _pair_in(place) is not None


def recognises_palette(place: Path) -> bool:
    return place.is_dir() and not any(place.glob("*.json")) and any(place.glob("*.png"))


def _pair_in(place: Path) -> tuple[Path, Path] | None:
    for classes, instances in PAIRS:
        if (place / classes).is_dir() and (place / instances).is_dir():
            return place / classes, place / instances
    return None


def read_pairs(place: Path, names: Sequence[str]) -> MaskSource:
    """Open both folders; headers only. Raises SceneError."""
    pair = _pair_in(place)
    if pair is None:
        raise SceneError("there are no two folders of classes and instances", place, f"Looked for {LOOKS_FOR_PAIRS}.")
    classes, instances = (files_by_stem(folder, SUFFIXES, _FIX) for folder in pair)
    require_all(names, classes, "mask", pair[0], _FIX)
    require_all(names, instances, "mask", pair[1], _FIX)
    sizes: dict[str, Size] = {}
    for name in names:
        sizes[name] = label_map_size(classes[name])
        if label_map_size(instances[name]) != sizes[name]:
            what = f"the instance image is not {shown_size(sizes[name])} as the classes are"
            raise SceneError(what, instances[name], "Make both with the same size.")
    readers = {name: PairReader(classes[name], instances[name]) for name in names}
    return MaskSource(None, readers, sizes, {name: classes[name] for name in names}, void=IGNORED)


def read_palette(place: Path, names: Sequence[str]) -> MaskSource:
    """Open the folder of classes; headers only. Raises SceneError."""
    files = files_by_stem(place, {".png"}, _FIX)
    require_all(names, files, "mask", place, _FIX)
    sizes = {name: label_map_size(files[name]) for name in names}
    readers = {name: PairReader(files[name], None) for name in names}
    return MaskSource(None, readers, sizes, {name: files[name] for name in names}, void=IGNORED)
