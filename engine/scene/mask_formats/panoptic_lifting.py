"""Panoptic Lifting's network masks: folders ``<prefix>_semantics`` and ``<prefix>_instance`` of label images.

There are two sets. The one with test-time augmentation (``m2f_``) is preferred to ``m2f_notta_``, because that
project's readers load it; the paper seems to use the other. A warning says how to choose.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...errors import PlgsError
from ..class_tables import REDUCED, known_table
from ..files_of_frames import files_of_both
from ..label_image import check_label_header
from .label_pairs import label_pairs
from .source import MaskFormat, MaskSource

_FIX = "Panoptic Lifting's masks are the folders m2f_semantics and m2f_instance."
_BOTH = "masks with test-time augmentation are used; for those without, name m2f_notta_semantics as the masks"


def _recognises(place: Path) -> bool:
    return _semantics_of(place) is not None


def _semantics_of(place: Path) -> Path | None:
    """The folder of classes: ``place`` itself or one of those in it."""
    if place.name.endswith("_semantics"):
        return place if place.is_dir() else None
    return next((each for each in (place / "m2f_semantics", place / "m2f_notta_semantics") if each.is_dir()), None)


def _read(place: Path, names: Sequence[str]) -> MaskSource:
    """Open ``<prefix>_semantics`` and the ``<prefix>_instance`` beside it; headers only. Raises PlgsError."""
    semantics = _semantics_of(place)
    if semantics is None:
        raise PlgsError("there are no masks", place, _FIX)
    instances = semantics.with_name(semantics.name.removesuffix("_semantics") + "_instance")
    fix = "Add PNGs named like the colour images."
    semantic_files, instance_files = files_of_both(semantics, instances, names, {".png"}, fix)
    for path in (*semantic_files.values(), *instance_files.values()):
        check_label_header(path)
    has_both = semantics != place and semantics.name == "m2f_semantics" and (place / "m2f_notta_semantics").is_dir()
    return MaskSource(
        label_pairs(semantic_files, instance_files),
        labels=known_table(REDUCED).labels,
        warnings=(_BOTH,) if has_both else (),
        table="Panoptic Lifting's reduced table (0 to 21)",
    )


FORMAT = MaskFormat("panoptic-lifting", _recognises, _read, in_scene=True, own_names=True)
