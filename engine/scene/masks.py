"""Finding a scene's panoptic masks and telling which kind they are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .coco_masks import open_coco_masks
from .frame import SceneError
from .mask_set import NO_MASKS, READ_FIX, MaskSet
from .panoptic_lifting_masks import open_panoptic_lifting_masks


def find_masks(scene: Path, masks: Path | None, names: Sequence[str]) -> MaskSet:
    """``open_masks``, or none at all where nobody named masks and the scene's folder has none. Raises SceneError."""
    places = ("panoptic.json", "m2f_semantics", "m2f_notta_semantics")
    if masks is None and not any((scene / name).exists() for name in places):
        return NO_MASKS
    return open_masks(scene, masks, names)


def open_masks(scene: Path, masks: Path | None, names: Sequence[str]) -> MaskSet:
    """Open the masks of the frames ``names``; headers and tables only. Raises SceneError.

    ``masks`` may be a COCO panoptic JSON file, a folder that holds ``panoptic.json``, a folder that holds
    ``m2f_semantics`` and ``m2f_instance``, or one folder ``<prefix>_semantics`` with its ``<prefix>_instance`` beside
    it. Without it the scene's folder is searched in the same order.

    Of Panoptic Lifting's two sets the one with test-time augmentation (``m2f_``) is taken and ``m2f_notta_`` only where
    it is alone, because the former is what that project's readers load; the paper seems to use the latter. A warning
    says how to choose.
    """
    place = scene if masks is None else masks
    if place.is_file():
        return open_coco_masks(place, names)
    if not place.is_dir():
        raise SceneError("there are no masks", place, READ_FIX)
    if masks is not None and place.name.endswith("_semantics"):
        return open_panoptic_lifting_masks(place, names)
    if (place / "panoptic.json").is_file():
        return open_coco_masks(place / "panoptic.json", names)
    if (place / "m2f_semantics").is_dir():
        found = open_panoptic_lifting_masks(place / "m2f_semantics", names)
        if (place / "m2f_notta_semantics").is_dir():
            note = "masks with test-time augmentation are used; name m2f_notta_semantics as the masks for those without"
            return MaskSet(found.classes, found.readers, found.sizes, found.paths, (*found.warnings, note))
        return found
    if (place / "m2f_notta_semantics").is_dir():
        return open_panoptic_lifting_masks(place / "m2f_notta_semantics", names)
    raise SceneError("there are no masks", place, READ_FIX)
