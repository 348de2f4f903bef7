"""Panoptic Lifting's machine masks: folders ``<prefix>_semantics`` and ``<prefix>_instance`` of label images.

Of its two sets the one with test-time augmentation (``m2f_``) is taken and ``m2f_notta_`` only where it is alone,
because the former is what that project's readers load; the paper seems to use the latter. A warning says how to choose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..class_tables import REDUCED, known_table
from ..frame import SceneError, Size
from ..label_image import check_label_header
from ..layout import files_by_stem, require_all, shown_size
from ..pixels import decode_single_channel
from .painting import segments_of_pairs
from .source import FoundMask, MaskSource

LOOKS_FOR = "m2f_semantics and m2f_instance"
_FIX = "Panoptic Lifting's masks are the folders m2f_semantics and m2f_instance."
_BOTH = "masks with test-time augmentation are used; name m2f_notta_semantics as the masks for those without"


@dataclass(frozen=True)
class PanopticLiftingMaskReader:
    """Reads one frame's mask: every pair of a class and an instance that occurs is a segment, numbered from 1."""

    semantic: Path
    instance: Path

    def __call__(self) -> FoundMask:
        """The mask. Raises SceneError for a bad file."""
        classes, instances = decode_single_channel(self.semantic), decode_single_channel(self.instance)
        if classes.shape != instances.shape:
            raise SceneError("the instance image has another size", self.instance, "Make it as large as the classes.")
        return segments_of_pairs(classes, instances)


def recognises(place: Path) -> bool:
    return _semantics_of(place) is not None


def _semantics_of(place: Path) -> Path | None:
    """The folder of classes: ``place`` itself or one of those in it."""
    if place.name.endswith("_semantics"):
        return place if place.is_dir() else None
    return next((each for each in (place / "m2f_semantics", place / "m2f_notta_semantics") if each.is_dir()), None)


def read(place: Path, names: Sequence[str]) -> MaskSource:
    """Open ``<prefix>_semantics`` and the ``<prefix>_instance`` beside it; headers only. Raises SceneError."""
    semantics = _semantics_of(place)
    if semantics is None:
        raise SceneError("there are no masks", place, _FIX)
    instances = semantics.with_name(semantics.name.removesuffix("_semantics") + "_instance")
    semantic_files = files_by_stem(semantics, {".png"}, _FIX)
    instance_files = files_by_stem(instances, {".png"}, f"Panoptic Lifting writes it beside {semantics.name}.")
    require_all(names, semantic_files, "mask", semantics, "Add PNGs named like the colour images.")
    require_all(names, instance_files, "mask", instances, "Add PNGs named like the colour images.")
    sizes: dict[str, Size] = {}
    for name in names:
        sizes[name] = check_label_header(semantic_files[name])
        if check_label_header(instance_files[name]) != sizes[name]:
            raise SceneError(
                f"the instance image is not {shown_size(sizes[name])} as the classes are",
                instance_files[name],
                "Make both with the same size.",
            )
    has_both = semantics != place and semantics.name == "m2f_semantics" and (place / "m2f_notta_semantics").is_dir()
    return MaskSource(
        labels=known_table(REDUCED).labels,
        readers={name: PanopticLiftingMaskReader(semantic_files[name], instance_files[name]) for name in names},
        sizes=sizes,
        paths={name: semantic_files[name] for name in names},
        warnings=(_BOTH,) if has_both else (),
        table="Panoptic Lifting's reduced table (0 to 21)",
    )
