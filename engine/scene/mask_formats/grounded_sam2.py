"""Grounded-SAM-2's tracks: ``mask_data/mask_<frame>.npy`` (object numbers, 0 = none), ``json_data/mask_<frame>.json``.

The JSON's ``labels`` give each object's ``instance_id``, ``class_name`` (a free text, as it was prompted), box and
``logit``, which is 0 where nobody filled it in. Numbers are the same in all frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..class_tables import is_thing_by_name
from ..classes import ClassLabel
from ..frame import SceneError
from ..json_file import read_json_object, take_text, take_whole_number, wrong_type
from ..layout import files_by_stem, listed, require_all
from .label_map import label_map_size, read_label_map
from .source import FoundMask, FoundSegment, MaskSource

LOOKS_FOR = "mask_data/mask_<frame>.npy and json_data/mask_<frame>.json"
_FIX = "Name the folder that Grounded-SAM-2 wrote, with mask_data and json_data."
_LARGEST_OBJECT = 65535


@dataclass(frozen=True)
class TrackedMaskReader:
    """Reads one frame; ``segments`` by the object's number."""

    array: Path
    table: Path
    segments: Mapping[int, FoundSegment]

    def __call__(self) -> FoundMask:
        """The mask. Raises SceneError for an object that the JSON does not have."""
        ids = read_label_map(self.array)
        present = [int(value) for value in np.unique(ids) if value]
        unknown = [value for value in present if value not in self.segments]
        if unknown:
            raise SceneError(f"objects {listed(unknown)} are missing in {self.table.name}", self.array, _FIX)
        return FoundMask(ids.astype(np.int32), tuple(self.segments[value] for value in present))


def recognises(place: Path) -> bool:
    return (place / "mask_data").is_dir() and (place / "json_data").is_dir()


def read(place: Path, names: Sequence[str]) -> MaskSource:
    """Open the masks; headers and JSON only. Raises SceneError."""
    arrays = _by_frame(place / "mask_data", ".npy")
    tables = _by_frame(place / "json_data", ".json")
    require_all(names, arrays, "mask", place / "mask_data", _FIX)
    require_all(names, tables, "JSON of objects", place / "json_data", _FIX)
    objects = {name: _objects(tables[name]) for name in names}
    words = sorted({word for found in objects.values() for word in found.values()})
    label_of = {word: number for number, word in enumerate(words, start=1)}
    segments = {
        name: {number: FoundSegment(number, label_of[word], track=number) for number, word in found.items()}
        for name, found in objects.items()
    }
    return MaskSource(
        labels=tuple(ClassLabel(label_of[word], word, is_thing_by_name(word) is not False) for word in words) or None,
        readers={name: TrackedMaskReader(arrays[name], tables[name], segments[name]) for name in names},
        sizes={name: label_map_size(arrays[name]) for name in names},
        paths={name: arrays[name] for name in names},
        tells_no_class=not words,
    )


def _by_frame(folder: Path, suffix: str) -> dict[str, Path]:
    """Files by the frame's name, which "mask_" comes before."""
    files = files_by_stem(folder, {suffix}, _FIX)
    return {stem.removeprefix("mask_"): path for stem, path in files.items()}


def _objects(path: Path) -> dict[int, str]:
    """The class of each object's number. Raises SceneError."""
    labels: Any = read_json_object(path).get("labels")
    if not isinstance(labels, dict):
        raise wrong_type("labels", "an object", labels, "the file", path)
    found = {}
    for key, entry in labels.items():
        if not isinstance(entry, dict):
            raise wrong_type(key[:20], "an object", entry, '"labels"', path)
        number = take_whole_number(entry, "instance_id", f"the object {key[:20]}", path)
        if not 1 <= number <= _LARGEST_OBJECT:
            raise SceneError(f"the object {key[:20]} has the number {number}", path, "Count objects from 1.")
        found[number] = take_text(entry, "class_name", f"the object {number}", path)
    return found
