"""SAM 2's tracks: one PNG per frame whose values number the objects, or one folder of black and white PNGs per object.

``<frame>.png`` with a palette, index = object, 0 = none; or ``<object>/<frame>.png``, anything but 0 is the object. The
numbers are the same in all frames. SAM 2 gives no classes: ``classes.toml`` may give each object's number one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from ...gates import open_plain
from ...posed.layout import files_by_stem, files_of_frames, of_most, require_most, whole_file
from ..label_image import label_header, read_indices
from .source import (
    FoundMask,
    FoundSegment,
    MaskFormat,
    MaskSource,
    StoredMask,
    painted_files,
    segments_of_objects,
)

_FIX = "Name the folder that SAM 2 wrote for the video: one PNG per frame, or one folder per object."


def _recognises(place: Path) -> bool:
    return bool(_object_folders(place)) or (_has_palette(place) and not any(place.glob("*.json")))


def _object_folders(place: Path) -> dict[int, Path]:
    """The folders whose names are numbers, if they hold PNGs."""
    if not place.is_dir():
        return {}
    folders = [path for path in sorted(place.iterdir()) if path.name.isdecimal() and path.is_dir()]
    return {int(path.name): path for path in folders if int(path.name) and any(path.glob("*.png"))}


def _has_palette(place: Path) -> bool:
    """Whether the first PNG of a folder has a palette."""
    first = next(iter(sorted(place.glob("*.png"))), None) if place.is_dir() else None
    if first is None:
        return False
    with open_plain(first) as file:
        return file.read(26)[25:26] == b"\3"  # the colour type of the header


def _read(place: Path, names: Sequence[str]) -> MaskSource:
    """Open the masks; headers only. Raises PlgsError."""
    folders = _object_folders(place)
    if not folders:
        files = files_of_frames(place, names, {".png"}, "mask", _FIX)
        masks = {
            name: StoredMask(path, label_header(path).size, partial(_read_map, path)) for name, path in files.items()
        }
        return MaskSource(masks, tells_no_class=True)
    found = {number: files_by_stem(folder, {".png"}, _FIX) for number, folder in folders.items()}
    of_frame = {name: {number: files[name] for number, files in found.items() if name in files} for name in names}
    there = require_most(names, [name for name in names if of_frame[name]], "mask", place, _FIX)
    whole = of_most(there, lambda name: [whole_file(path) for path in of_frame[name].values()])
    return MaskSource({name: _of_objects(of_frame[name]) for name in whole}, tells_no_class=True)


def _read_map(path: Path) -> FoundMask:
    return segments_of_objects(read_indices(path))


def _of_objects(files: Mapping[int, Path]) -> StoredMask:
    """A frame's mask out of a black and white PNG for each object's number. Smaller objects are on top."""
    paths = (*files.values(),)
    size = label_header(paths[0]).size
    segments = [FoundSegment(number, number, track=number) for number in files]
    return StoredMask(paths[0], size, partial(painted_files, paths, segments, size, _FIX))


FORMAT = MaskFormat("sam2", _recognises, _read)
