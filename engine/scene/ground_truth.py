"""Ground truth for the metrics: never read by the lift itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..errors import PlgsError
from ..posed.classes import VOID
from ..posed.image_header import check_image_file
from ..posed.layout import files_by_stem, natural_order, same_shape, shown_size
from .frame import GroundTruth, Size
from .label_image import check_label_header
from .mask_formats.source import IGNORED
from .masks import MaskSet
from .noted import Inferred
from .pixels import decode_single_channel, distinct_ids, resize_nearest
from .truth_numbers import in_classes, numbers_of_truth

_FIX = "Correct it, or remove the ground truth: only the metrics need it."


@dataclass(frozen=True)
class GroundTruthReader:
    """Reads one frame's ground truth. ``class_of`` maps its class ids to the masks', void where they have none of the
    same name; ids that it does not have become void, too. ``names`` are those of its own table, if it has one."""

    semantic: Path
    instance: Path
    class_of: Mapping[int, int]
    names: Mapping[int, str]

    def __call__(self, size: Size | None = None) -> GroundTruth:
        """Ground truth at ``size`` (width, height) or its own. Raises PlgsError when a file is bad."""
        stored = read_label_pair(self.semantic, self.instance)
        semantic, instance = in_classes(stored.semantic, self.class_of), stored.instance
        if size is not None:
            semantic, instance = resize_nearest(semantic, size), resize_nearest(instance, size)
        return GroundTruth(semantic, instance)

    def unknown(self) -> frozenset[int | str]:
        """Classes in the file, void aside, that the masks' table does not have: names, or ids without one. Raises
        PlgsError for a bad file."""
        check_image_file(self.instance)
        found, _ = distinct_ids(decode_single_channel(self.semantic))
        lacking = frozenset(found.tolist()) - frozenset(self.class_of) - (IGNORED if self.names else {VOID})
        return frozenset(self.names.get(number, number) for number in lacking)


def read_label_pair(semantic: Path, instance: Path) -> GroundTruth:
    """Class ids and instance ids out of two label images. Raises PlgsError when a file is bad."""
    stored = GroundTruth(decode_single_channel(semantic), decode_single_channel(instance))
    if stored.semantic.shape != stored.instance.shape:
        raise PlgsError("classes and instances differ in size", instance, "Make both the same size.")
    return stored


def open_ground_truth(
    scene: Path, sizes: Mapping[str, Size], masks: MaskSet
) -> tuple[dict[str, GroundTruthReader], tuple[str, ...], tuple[Inferred, ...]]:
    """Ground truth in ``rs_semantics`` and ``rs_instance``, or ``gt/semantic*`` and ``gt/instance``; headers only.

    The result has a reader for each frame with ground truth, warnings, and what was inferred. ``sizes`` are those of
    the colour images by frame. Its classes become those of the ``masks``, see ``numbers_of_truth``. Raises PlgsError
    when an image is not a label image or has another shape.
    """
    folders = _find_folders(scene) if masks.readers else None
    if folders is None:
        return {}, (), ()
    semantics = files_by_stem(folders[0], {".png"}, _FIX)
    instances = files_by_stem(folders[1], {".png"}, _FIX)
    pairs = {name: (semantics[name], instances[name]) for name in sizes if name in semantics and name in instances}
    for name, paths in pairs.items():
        for path in paths:
            own = check_label_header(path)
            if not same_shape(own, sizes[name]):
                what = f"ground truth of {shown_size(own)} does not fit the colour of {shown_size(sizes[name])}"
                raise PlgsError(what, path, _FIX)
    numbers = numbers_of_truth(folders[0], {name: semantic for name, (semantic, _) in pairs.items()}, masks)
    readers = {name: GroundTruthReader(*paths, numbers.class_of, numbers.names) for name, paths in pairs.items()}
    lacking = f"{len(sizes) - len(readers)} of {len(sizes)} frames have no ground truth in {folders[0].name}"
    return readers, (lacking,) if len(readers) < len(sizes) else (), numbers.inferred


def _find_folders(scene: Path) -> tuple[Path, Path] | None:
    """The folders of classes and of instances; None when either is missing."""
    if (scene / "rs_semantics").is_dir() and (scene / "rs_instance").is_dir():
        return scene / "rs_semantics", scene / "rs_instance"
    found = [path for path in (scene / "gt").glob("semantic*") if path.is_dir()]
    if found and (scene / "gt" / "instance").is_dir():
        return min(found, key=lambda path: natural_order(path.name)), scene / "gt" / "instance"
    return None
