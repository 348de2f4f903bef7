"""The formats of masks: one reader each, which recognises its files and reads segments.

A new format's ``MaskFormat`` goes into ``MASK_FORMATS``, and its name into ``engine/scene_source.py``."""

from __future__ import annotations

from pathlib import Path

from ...errors import PlgsError, reading
from ...posed.layout import listed, shown, shown_files
from ...scene_source import MASK_FORMAT_NAMES
from . import class_arrays, coco, coco_results, detections, label_pairs, sam2, segment_maps
from .source import FoundMask, FoundSegment, MaskFormat, MaskSource, StoredMask

MASK_FORMATS: tuple[MaskFormat, ...] = (
    coco_results.FORMAT, coco.FORMAT, label_pairs.PANOPTIC_LIFTING, sam2.GROUNDED, sam2.PICTURES,
    label_pairs.PAIRS_FORMAT, segment_maps.TRANSFORMERS, segment_maps.DETECTRON2, sam2.FORMAT, label_pairs.PALETTE,
    detections.FORMAT, class_arrays.FORMAT,
)  # fmt: skip
_PICKLES = {".pkl", ".pickle", ".pt", ".pth", ".ptz", ".joblib"}


def find_mask_format(place: Path, name: str | None = None) -> MaskFormat:
    """Return the format called ``name``, or the one that recognises ``place``, a folder or file. Raises PlgsError for
    an unknown name, and if no format or more than one recognises it."""
    known = {each.name: each for each in MASK_FORMATS}
    if name is not None:
        if name not in known:
            fix = f"Choose one of {', '.join(known)}."
            what = f'no mask format is called "{shown(name)}"'
            raise PlgsError("unknown-format", what, place, fix, option="--mask-format")
        return known[name]
    if not place.exists():
        raise PlgsError("no-masks", "there are no masks", place, "Name a folder of masks.")
    with reading(place, "Check its permissions."):
        found = [each for each in MASK_FORMATS if each.own_names and each.recognises(place)][:1]
        found = found or [each for each in MASK_FORMATS if not each.own_names and each.recognises(place)]
    if len(found) > 1:
        names = " and ".join(each.name for each in found)
        fix = f"Say which one it is, such as --mask-format {found[0].name}."
        raise PlgsError("several-formats", f"these masks look like {names}", place, fix, option="--mask-format")
    if not found:
        _refuse_unread(place)
        wanted = "; ".join(f"{each.name}: {each.looks_for}" for each in MASK_FORMAT_NAMES)
        raise PlgsError("no-known-masks", "there are no masks of a known format", place, f"Looked for {wanted}.")
    return found[0]


def _refuse_unread(place: Path) -> None:
    files = [place] if place.is_file() else [path for path in sorted(shown_files(place)) if path.is_file()]
    pickles = [path.name for path in files if path.suffix.lower() in _PICKLES]
    if pickles:
        fix = "Save the arrays with numpy.save and other data as JSON."
        what = f"masks are pickled ({listed(pickles, 2)}), which could run code when they are read"
        raise PlgsError("pickled", what, place, fix)
    if passes := [path.name for path in files if path.suffix.lower() == ".exr"]:
        what = f"masks are OpenEXR passes ({listed(passes, 2)}), which are not read, Cryptomattes included"
        raise PlgsError("exr-masks", what, place, "Write the ids as COCO panoptic PNGs, unfiltered and at full size.")
