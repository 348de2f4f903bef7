"""NumPy arrays of classes a frame: a picture of numbers, or the probability of each class at each pixel.

``<frame>.npy`` or ``.npz``. Whole numbers [H, W] are classes; beside them an .npz may have instances (``instance``).
Floats [C, H, W] or [H, W, C] are probabilities, or shares of whatever sum: the greatest wins, channel k is the class k
of the table that the user names, and what the winners had on average is the segment's score.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..frame import SceneError, Size
from ..layout import files_by_stem, require_all
from .label_map import whole_numbers
from .mask_arrays import array_headers, read_array
from .painting import segments_of_labels, segments_of_pairs
from .source import IGNORED, FoundMask, FoundSegment, MaskSource

LOOKS_FOR = "<frame>.npy or .npz with classes [H, W], or with probabilities [C, H, W]"
_CLASSES = ("semantic", "semantics", "labels", "label_map", "classes", "probabilities", "probability", "probs", "arr_0")
_INSTANCES = ("instance", "instances")
_FIX = "Save classes [H, W] as whole numbers, or probabilities [C, H, W] as floats."


@dataclass(frozen=True)
class ClassArrayReader:
    """Reads one frame's array ``name``, and its ``instances`` where it has any."""

    path: Path
    name: str
    instances: str | None

    def __call__(self) -> FoundMask:
        """The mask. Raises SceneError for a bad file."""
        values = read_array(self.path, self.name)
        if values.ndim == 3:
            return _most_probable(values, self.path)
        labels = whole_numbers(values, self.path)
        if self.instances is None:
            return segments_of_labels(labels)
        instances = whole_numbers(read_array(self.path, self.instances), self.path)
        if instances.shape != labels.shape:
            raise SceneError("instances and classes differ in size", self.path, _FIX)
        return segments_of_pairs(labels, instances)


def _most_probable(values: NDArray[Any], path: Path) -> FoundMask:
    """Of [C, H, W] or [H, W, C]: channels are fewer than rows and columns."""
    if _is_channels_last(values.shape):
        values = np.moveaxis(values, -1, 0)
    values = values.astype(np.float32)
    if not np.isfinite(values).all():
        raise SceneError("probabilities are no numbers", path, _FIX)
    if values.min() < 0.0:
        raise SceneError("these are no probabilities but logits", path, "Save what softmax makes of them.")
    labels, best = values.argmax(0), values.max(0)
    labels = np.where(best > 0.0, labels, -1)
    share = best / np.maximum(values.sum(0), 1e-12)
    found = segments_of_labels(labels)
    scored = tuple(
        FoundSegment(one.id, one.label, float(share[found.ids == one.id].mean()), has_instance=False)
        for one in found.segments
    )
    return FoundMask(found.ids, scored)


def _is_channels_last(shape: tuple[int, ...]) -> bool:
    return shape[2] < min(shape[0], shape[1])


def recognises(place: Path) -> bool:
    if not place.is_dir() or any(place.glob("*.json")):
        return False
    first = next(iter(sorted([*place.glob("*.npy"), *place.glob("*.npz")])), None)
    return first is not None and _name_of(first) is not None


def _name_of(path: Path) -> str | None:
    """The array of classes; None where the file has none that could be it."""
    headers = array_headers(path)
    if any("mask" in name for name in headers):
        return None
    return next((name for name in ("", *_CLASSES) if name in headers), None)


def read(place: Path, names: Sequence[str]) -> MaskSource:
    """Open the arrays; headers only. Raises SceneError."""
    files = files_by_stem(place, {".npy", ".npz"}, _FIX)
    require_all(names, files, "mask", place, _FIX)
    readers, sizes = {}, {}
    for name in names:
        key = _name_of(files[name])
        if key is None:
            raise SceneError("there is no array of classes", files[name], f"Call it {_CLASSES[0]}. {_FIX}")
        headers = array_headers(files[name])
        sizes[name] = _size(headers[key].shape, headers[key].kind, files[name])
        readers[name] = ClassArrayReader(files[name], key, next((one for one in _INSTANCES if one in headers), None))
    return MaskSource(None, readers, sizes, {name: files[name] for name in names}, void=IGNORED)


def _size(shape: tuple[int, ...], kind: str, path: Path) -> Size:
    if len(shape) == 2 and kind in "iubf" and 0 not in shape:
        return shape[1], shape[0]
    if len(shape) == 3 and kind == "f" and 0 not in shape:
        return (shape[1], shape[0]) if _is_channels_last(shape) else (shape[2], shape[1])
    raise SceneError(f"an array of the shape {list(shape)} is no mask", path, _FIX)
