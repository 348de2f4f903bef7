"""SAM 2's tracks: a PNG a frame whose values number the objects, or a folder of black and white PNGs an object.

``<frame>.png`` with a palette, index = object, 0 = none; or ``<object>/<frame>.png``, anything but 0 is the object. The
numbers are the same in all frames. SAM 2 gives no classes: ``classes.toml`` may give each object's number one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...gates import open_plain
from ..frame import SceneError, Size
from ..layout import files_by_stem, require_all, shown_size
from .label_map import label_header, read_indices
from .painting import paint
from .source import FoundMask, FoundSegment, MaskSource

LOOKS_FOR = "<frame>.png with a palette, or <object number>/<frame>.png"
_FIX = "Name the folder that SAM 2 wrote for the video: a PNG a frame, or a folder an object."


@dataclass(frozen=True)
class ObjectMapReader:
    """Reads one frame in which each value is an object."""

    path: Path

    def __call__(self) -> FoundMask:
        """The mask. Raises SceneError for a bad file."""
        ids = read_indices(self.path)
        objects = [int(value) for value in np.unique(ids) if value]
        return FoundMask(ids, tuple(FoundSegment(one, one, track=one) for one in objects))


@dataclass(frozen=True)
class ObjectFoldersReader:
    """Reads one frame out of the folders of its objects: ``paths`` by the object's number."""

    paths: Mapping[int, Path]
    size: Size

    def __call__(self) -> FoundMask:
        """The mask: of objects that overlap, the smaller is on top. Raises SceneError for a bad file."""
        masks, segments = [], []
        for number, path in self.paths.items():
            mask = read_indices(path) > 0
            if mask.shape != self.size[::-1]:
                raise SceneError(f"this mask is not {shown_size(self.size)} as the others are", path, _FIX)
            if mask.any():
                masks.append(mask)
                segments.append(FoundSegment(number, number, track=number))
        if not masks:
            return FoundMask(np.zeros(self.size[::-1], np.int32), ())
        return FoundMask(paint(masks, segments), tuple(segments))


def recognises(place: Path) -> bool:
    return bool(object_folders(place)) or (has_palette(place) and not any(place.glob("*.json")))


def object_folders(place: Path) -> dict[int, Path]:
    """The folders whose names are numbers, if they hold PNGs."""
    if not place.is_dir():
        return {}
    folders = [path for path in sorted(place.iterdir()) if path.name.isdecimal() and path.is_dir()]
    return {int(path.name): path for path in folders if int(path.name) and any(path.glob("*.png"))}


def has_palette(place: Path) -> bool:
    """Whether the first PNG of a folder has a palette."""
    first = next(iter(sorted(place.glob("*.png"))), None) if place.is_dir() else None
    if first is None:
        return False
    with open_plain(first) as file:
        return file.read(26)[25:26] == b"\3"  # the colour type of the header


def read(place: Path, names: Sequence[str]) -> MaskSource:
    """Open the masks; headers only. Raises SceneError."""
    folders = object_folders(place)
    return _from_folders(place, folders, names) if folders else _from_maps(place, names)


def _from_maps(place: Path, names: Sequence[str]) -> MaskSource:
    files = files_by_stem(place, {".png"}, _FIX)
    require_all(names, files, "mask", place, _FIX)
    return MaskSource(
        labels=None,
        readers={name: ObjectMapReader(files[name]) for name in names},
        sizes={name: label_header(files[name]).size for name in names},
        paths={name: files[name] for name in names},
        tells_no_class=True,
    )


def _from_folders(place: Path, folders: Mapping[int, Path], names: Sequence[str]) -> MaskSource:
    files = {number: files_by_stem(folder, {".png"}, _FIX) for number, folder in folders.items()}
    of_frame = {name: {n: found[name] for n, found in files.items() if name in found} for name in names}
    require_all(names, [name for name in names if of_frame[name]], "mask", place, _FIX)
    first = {name: next(iter(of_frame[name].values())) for name in names}
    sizes = {name: label_header(first[name]).size for name in names}
    return MaskSource(
        labels=None,
        readers={name: ObjectFoldersReader(of_frame[name], sizes[name]) for name in names},
        sizes=sizes,
        paths=first,
        tells_no_class=True,
    )
