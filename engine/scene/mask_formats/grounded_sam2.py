"""Grounded-SAM-2's tracks: ``mask_data/mask_<frame>.npy`` (object numbers, 0 = none), ``json_data/mask_<frame>.json``.

The JSON's ``labels`` give each object's ``instance_id``, ``class_name`` (a free text, as it was prompted), box and
``logit``, which is 0 if it was not set. Numbers are the same in all frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import PlgsError
from ...json_file import read_json_object, take_text, take_whole_number, wrong_type
from ...posed.layout import files_by_stem, listed, of_most, require_most
from ..files_of_frames import whole_file
from ..label_image import label_map_size, read_label_map
from .source import FoundMask, FoundSegment, MaskFormat, MaskSource, StoredMask, named_labels

_FIX = "Name the folder that Grounded-SAM-2 wrote, with mask_data and json_data."
_LARGEST_OBJECT = 65535


def _read_mask(array: Path, table: str, segments: Mapping[int, FoundSegment]) -> FoundMask:
    """One frame; ``segments`` by the object's number. Raises PlgsError for an object that the JSON does not have."""
    ids = read_label_map(array)
    present = [int(value) for value in np.unique(ids) if value]
    unknown = [value for value in present if value not in segments]
    if unknown:
        raise PlgsError(f"objects {listed(unknown)} are missing from {table}", array, _FIX)
    return FoundMask(ids.astype(np.int32), tuple(segments[value] for value in present))


def _recognises(place: Path) -> bool:
    return (place / "mask_data").is_dir() and (place / "json_data").is_dir()


def _read(place: Path, names: Sequence[str]) -> MaskSource:
    """Open the masks; headers and JSON only. Raises PlgsError."""
    arrays = _by_frame(place / "mask_data", ".npy")
    tables = _by_frame(place / "json_data", ".json")
    there = require_most(names, arrays, "mask", place / "mask_data", _FIX)
    there = require_most(there, tables, "JSON of objects", place / "json_data", _FIX)
    whole = of_most(there, lambda name: (whole_file(arrays[name]), whole_file(tables[name])))
    objects = {name: _objects(tables[name]) for name in whole}
    label_of, labels = named_labels({word for found in objects.values() for word in found.values()})
    masks = {}
    for name, found in objects.items():
        path = arrays[name]
        segments = {number: FoundSegment(number, label_of[word], track=number) for number, word in found.items()}
        read = partial(_read_mask, path, tables[name].name, segments)
        masks[name] = StoredMask(path, label_map_size(path), read)
    return MaskSource(masks, labels or None, tells_no_class=not labels)


def _by_frame(folder: Path, suffix: str) -> dict[str, Path]:
    """Files by the frame's name, which follows "mask_" in theirs."""
    files = files_by_stem(folder, {suffix}, _FIX)
    return {stem.removeprefix("mask_"): path for stem, path in files.items()}


def _objects(path: Path) -> dict[int, str]:
    """The class of each object's number. Raises PlgsError."""
    labels: Any = read_json_object(path).get("labels")
    if not isinstance(labels, dict):
        raise wrong_type("labels", "an object", labels, "the file", path)
    found = {}
    for key, entry in labels.items():
        if not isinstance(entry, dict):
            raise wrong_type(key[:20], "an object", entry, '"labels"', path)
        number = take_whole_number(entry, "instance_id", f"the object {key[:20]}", path)
        if not 1 <= number <= _LARGEST_OBJECT:
            raise PlgsError(f"the object {key[:20]} has the number {number}", path, "Count objects from 1.")
        found[number] = take_text(entry, "class_name", f"the object {number}", path)
    return found


FORMAT = MaskFormat("grounded-sam2", _recognises, _read, own_names=True)
