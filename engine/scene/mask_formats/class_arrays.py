"""A NumPy array of classes per frame: a picture of numbers, or the probability of each class at each pixel.

``<frame>.npy`` or ``.npz``. Whole numbers [H, W] are classes; an .npz may also hold instances (``instance``). Floats
[C, H, W] or [H, W, C] are probabilities, not necessarily normalised: the greatest wins. Channel k is the class k of the
table that the user names. A segment's score is the mean probability of its pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.array_file import array_headers, read_array
from ..files_of_frames import files_of_frames, mask_files
from ..frame import Size
from ..pixels import whole_numbers
from ..view import Progress
from .source import IGNORED, FoundMask, MaskFormat, MaskSource, StoredMask, segments_of_labels, segments_of_pairs

_CLASSES = ("semantic", "semantics", "labels", "label_map", "classes", "probabilities", "probability", "probs", "arr_0")
_INSTANCES = ("instance", "instances")
_FIX = "Save classes [H, W] as whole numbers, or probabilities [C, H, W] as floats."


def _read_mask(path: Path, name: str, instances_name: str | None) -> FoundMask:
    values = read_array(path, name)
    if values.ndim == 3:
        return _most_probable(values, path)
    labels = whole_numbers(values, path)
    if instances_name is None:
        return segments_of_labels(labels)
    instances = whole_numbers(read_array(path, instances_name), path)
    if instances.shape != labels.shape:
        raise PlgsError("other-size", "instances and classes differ in size", path, _FIX)
    return segments_of_pairs(labels, instances)


def _most_probable(values: NDArray[Any], path: Path) -> FoundMask:
    """Return the mask of the most probable classes. ``values`` are [C, H, W] or [H, W, C]: the shortest side is C."""
    if _is_channels_last(values.shape):
        values = np.moveaxis(values, -1, 0)
    values = values.astype(np.float32)
    if not np.isfinite(values).all():
        raise PlgsError("not-numbers", "probabilities are not numbers", path, _FIX)
    if values.min() < 0.0:
        raise PlgsError("logits", "these are logits, not probabilities", path, "Save them after a softmax.")
    labels, best = values.argmax(0), values.max(0)
    labels = np.where(best > 0.0, labels, -1)
    share = best / np.maximum(values.sum(0), 1e-12)
    found = segments_of_labels(labels)
    scored = (replace(one, score=float(share[found.ids == one.id].mean())) for one in found.segments)
    return FoundMask(found.ids, tuple(scored))


def _is_channels_last(shape: tuple[int, ...]) -> bool:
    return shape[2] < min(shape[0], shape[1])


def _name_of(path: Path) -> str | None:
    """Return the name of the array of classes in an .npz ("" for a .npy); None if there is no such array."""
    headers = array_headers(path)
    if any("mask" in name for name in headers):
        return None
    return next((name for name in ("", *_CLASSES) if name in headers), None)


def _read(place: Path, names: Sequence[str], progress: Progress) -> MaskSource:
    masks = {}
    for name, path in files_of_frames(place, names, {".npy", ".npz"}, what="mask", fix=_FIX, progress=progress).items():
        key = _name_of(path)
        if key is None:
            raise PlgsError("no-class-array", "there is no array of classes", path, f"Name it {_CLASSES[0]}. {_FIX}")
        headers = array_headers(path)
        instances = next((one for one in _INSTANCES if one in headers), None)
        size = _size(headers[key].shape, headers[key].kind, path)
        masks[name] = StoredMask(path, size, partial(_read_mask, path, key, instances))
    return MaskSource(masks, void=IGNORED)


def _size(shape: tuple[int, ...], kind: str, path: Path) -> Size:
    if len(shape) == 2 and kind in "iubf" and 0 not in shape:
        return shape[1], shape[0]
    if len(shape) == 3 and kind == "f" and 0 not in shape:
        return (shape[1], shape[0]) if _is_channels_last(shape) else (shape[2], shape[1])
    raise PlgsError("shape", f"an array of the shape {list(shape)} is not a mask", path, _FIX)


FORMAT = MaskFormat(
    "arrays",
    lambda place: (
        not mask_files(place, ".json")
        and any(_name_of(first) is not None for first in mask_files(place, ".npy", ".npz")[:1])
    ),
    _read,
)
