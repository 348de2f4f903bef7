"""Which mask format is it? Each is recognised by its files' names, headers and first keys; no picture is decoded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..frame import SceneError
from ..layout import listed, shown
from . import (
    class_arrays,
    coco,
    detections,
    exr_masks,
    grounded_sam2,
    label_pairs,
    panoptic_lifting,
    sam2,
    segment_maps,
)
from .source import MaskSource


@dataclass(frozen=True)
class MaskFormat:
    """A format: the ``name`` that users give, what is looked for, whether a place has it, and its reader.

    ``read`` gets the frames' names and raises SceneError. ``in_scene``: looked for in the scene's own folder as well.
    ``own_names``: its files have names of their own, so it comes before formats that look like others as well.
    """

    name: str
    looks_for: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, Sequence[str]], MaskSource]
    in_scene: bool = False
    own_names: bool = False


MASK_FORMATS: tuple[MaskFormat, ...] = (
    MaskFormat("coco", coco.LOOKS_FOR, coco.recognises, coco.read, in_scene=True, own_names=True),
    MaskFormat(
        "panoptic-lifting",
        panoptic_lifting.LOOKS_FOR,
        panoptic_lifting.recognises,
        panoptic_lifting.read,
        in_scene=True,
        own_names=True,
    ),
    MaskFormat("grounded-sam2", grounded_sam2.LOOKS_FOR, grounded_sam2.recognises, grounded_sam2.read, own_names=True),
    MaskFormat(
        "pairs", label_pairs.LOOKS_FOR_PAIRS, label_pairs.recognises_pairs, label_pairs.read_pairs, own_names=True
    ),
    MaskFormat(
        "transformers",
        segment_maps.LOOKS_FOR_TRANSFORMERS,
        segment_maps.recognises_transformers,
        segment_maps.read_transformers,
    ),
    MaskFormat(
        "detectron2",
        segment_maps.LOOKS_FOR_DETECTRON2,
        segment_maps.recognises_detectron2,
        segment_maps.read_detectron2,
    ),
    MaskFormat("sam2", sam2.LOOKS_FOR, sam2.recognises, sam2.read),
    MaskFormat("palette", label_pairs.LOOKS_FOR_PALETTE, label_pairs.recognises_palette, label_pairs.read_palette),
    MaskFormat("detections", detections.LOOKS_FOR, detections.recognises, detections.read),
    MaskFormat(
        "cryptomatte", exr_masks.LOOKS_FOR_CRYPTOMATTE, exr_masks.recognises_cryptomatte, exr_masks.read_cryptomatte
    ),
    MaskFormat("object-index", exr_masks.LOOKS_FOR_INDEX, exr_masks.recognises_index, exr_masks.read_index),
    MaskFormat("arrays", class_arrays.LOOKS_FOR, class_arrays.recognises, class_arrays.read),
)
_PICKLES = {".pkl", ".pickle", ".pt", ".pth", ".ptz", ".joblib"}


def find_mask_format(place: Path, name: str | None = None) -> MaskFormat:
    """The format called ``name``, or the one that ``place``, a folder or file, has by its looks.

    Raises SceneError for an unknown name, and when no format or more than one is recognised.
    """
    known = {each.name: each for each in MASK_FORMATS}
    if name is not None:
        if name not in known:
            raise SceneError(f'no mask format is called "{shown(name)}"', place, f"Choose one of {', '.join(known)}.")
        return known[name]
    if not place.exists():
        raise SceneError("there are no masks", place, "Name a folder of masks.")
    try:
        seen = [each for each in MASK_FORMATS if each.recognises(place)]
        found = [each for each in seen if each.own_names][:1] or seen
    except OSError as error:
        raise SceneError(f"the folder cannot be read ({error.strerror})", place, "Check its permissions.") from error
    if len(found) > 1:
        names = " and ".join(each.name for each in found)
        fix = f"Say which one it is, such as --mask-format {found[0].name}."
        raise SceneError(f"these masks look like {names}", place, fix)
    if not found:
        _refuse_pickles(place)
        wanted = "; ".join(f"{each.name}: {each.looks_for}" for each in MASK_FORMATS)
        raise SceneError("there are no masks of a known format", place, f"Looked for {wanted}.")
    return found[0]


def _refuse_pickles(place: Path) -> None:
    files = [place] if place.is_file() else [path for path in sorted(place.iterdir()) if path.is_file()]
    pickles = [path.name for path in files if path.suffix.lower() in _PICKLES]
    if pickles:
        fix = "Save the arrays with numpy.save and what belongs to them as JSON."
        what = f"masks are pickled ({listed(pickles, 2)}), which could run code when they are read"
        raise SceneError(what, place, fix)
