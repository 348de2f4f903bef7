"""SAM's masks. SAM 2 gives tracks through all frames, SAM 1's ``amg.py`` regions of one picture; neither has classes.
Grounded-SAM-2's tracks do.

* SAM 2: ``<frame>.png`` with a palette, index = object, 0 = none; or ``<object>/<frame>.png``, a mask of the object,
  whose number may be 0. The numbers are the same in all frames: ``classes.toml`` may give each one a class.
* ``amg.py``: ``<frame>/<k>.png`` beside ``<frame>/metadata.csv``, which lists each k. A smaller region is on top.
* Grounded-SAM-2: ``mask_data/mask_<frame>.npy`` (object numbers, 0 = none, the same in all frames). The ``labels`` of
  ``json_data/mask_<frame>.json`` give each object's ``instance_id`` and ``class_name`` (free text from the prompt)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import PlgsError
from ...gates import open_plain
from ...json_file import read_json_object, take_text, take_whole_number, wrong_type
from ...posed.layout import files_by_stem, listed, of_most, require_all, require_most, shown_files
from ..files_of_frames import AMG_LIST, DETECTION, files_of_frames, is_camera, mask_files, whole_file
from ..formats.poses import read_rows
from ..pixels import label_header, label_map_size, read_indices, read_label_map, shows_one_object
from ..values import by_colour, numbers_of_colours
from ..view import Progress, watched
from .source import FoundMask, FoundSegment, MaskFormat, MaskSource, StoredMask, named_labels, pile

_FIX = "Name the folder that SAM 2 wrote for the video: one PNG per frame, or one folder per object."
_LOOKED_AT = 8  # maximum number of folders whose first picture is inspected
_BY_COLOUR = "the masks have a palette each, so an object is known by its colour"
_LIST_FIX = "Name the folder that SAM's amg.py wrote: one folder per picture, whole, with its metadata.csv."
_NO_LABEL = -1  # in no table: a region's number does not give its class


def _object_folders(place: Path) -> dict[int, Path]:
    """Return the folders by object number, if each holds one object's PNGs, rather than a picture's or a camera's."""
    if not place.is_dir():
        return {}
    folders = (path for path in sorted(shown_files(place)) if path.is_dir())
    firsts = {path: min(shown_files(path, "*.png"), default=None) for path in folders}
    seen = {path: first for path, first in firsts.items() if first is not None and not (path / AMG_LIST).exists()}
    are_numbers = all(path.name.isdecimal() for path in seen)
    of_one = [shows_one_object(first) for first in [*seen.values()][:_LOOKED_AT]]
    are_objects = any(of_one) if are_numbers else all(of_one)
    if not are_objects or any(is_camera(path) or DETECTION.fullmatch(first.stem) for path, first in seen.items()):
        return {}
    return {int(path.name) if are_numbers else n: path for n, path in enumerate(seen, start=1)}


def _has_palette(place: Path) -> bool:
    for first in mask_files(place, ".png")[:1]:
        with open_plain(first) as file:
            return file.read(26)[25:26] == b"\3"  # the colour type of the header
    return False


def _read(place: Path, names: Sequence[str], progress: Progress) -> MaskSource:
    folders = _object_folders(place)
    if not folders:
        files = files_of_frames(place, names, {".png"}, what="mask", fix=_FIX, progress=progress)
        sizes = {name: label_header(path).size for name, path in files.items()}
        numbers = numbers_of_colours([*files.values()])
        masks = {name: StoredMask(path, sizes[name], partial(_read_map, path, numbers)) for name, path in files.items()}
        return MaskSource(masks, warnings=(_BY_COLOUR,) if numbers else (), tells_no_class=True)
    # Segments are numbered from 1, objects perhaps from 0.
    segments = {number: FoundSegment(n, number, track=number) for n, number in enumerate(folders, start=1)}
    found = {number: files_by_stem(folder, {".png"}, _FIX) for number, folder in folders.items()}
    of_frame = {name: {number: files[name] for number, files in found.items() if name in files} for name in names}
    there = require_most(names, [name for name in names if of_frame[name]], "mask", place, _FIX)
    whole = of_most(there, lambda name: [whole_file(path) for path in of_frame[name].values()], progress)
    masks = {name: pile([*of_frame[name].values()], [segments[n] for n in of_frame[name]], _FIX) for name in whole}
    return MaskSource(masks, tells_no_class=True, void=frozenset())


def _read_map(path: Path, numbers: Mapping[bytes, int] | None) -> FoundMask:
    ids = read_indices(path) if numbers is None else by_colour(read_indices(path), path, numbers)
    objects = (int(value) for value in np.unique(ids) if value)  # the same in all frames
    return FoundMask(ids, tuple(FoundSegment(one, one, track=one) for one in objects))


def _picture_folders(place: Path) -> list[Path]:
    """Return the folders of pictures in which ``amg.py`` found regions."""
    lists = shown_files(place, f"*/{AMG_LIST}") if place.is_dir() else ()
    return [path.parent for path in lists if any(shown_files(path.parent, "*.png"))]


def _read_pictures(place: Path, names: Sequence[str], progress: Progress) -> MaskSource:
    require_all(names, [path.name for path in _picture_folders(place)], f"PNGs with {AMG_LIST}", place, _LIST_FIX)
    return MaskSource({name: _regions(place / name) for name in watched(names, progress)}, tells_no_class=True)


def _regions(folder: Path) -> StoredMask:
    """Read a picture's mask from the PNGs that its metadata.csv lists. Raises PlgsError unless all exist."""
    files = files_by_stem(folder, {".png"}, _LIST_FIX)
    wanted = [row.words[0] for row in read_rows(folder / AMG_LIST, _LIST_FIX, ",") if row.words[0].isdecimal()]
    lacking = [f"{k}.png" for k in wanted if k not in files]
    if lacking or not wanted:
        what = f"PNGs of {AMG_LIST} are missing ({listed(lacking)})" if wanted else f"{AMG_LIST} lists none of the PNGs"
        raise PlgsError("list-unmatched", what, folder, _LIST_FIX)
    segments = [FoundSegment(n, _NO_LABEL) for n in range(1, len(wanted) + 1)]
    return pile([files[k] for k in wanted], segments, _LIST_FIX)


FORMAT = MaskFormat(
    "sam2",
    lambda place: bool(_object_folders(place)) or (_has_palette(place) and not mask_files(place, ".json")),
    _read,
)
PICTURES = MaskFormat("sam", lambda place: bool(_picture_folders(place)), _read_pictures, own_names=True)


_GROUNDED_FIX = "Name the folder that Grounded-SAM-2 wrote, with mask_data and json_data."
_LARGEST_OBJECT = 65535


def _read_mask(array: Path, table: str, segments: Mapping[int, FoundSegment]) -> FoundMask:
    """Read a frame's mask from a .npy of object numbers. ``segments`` are by number. Raises PlgsError for bad files."""
    ids = read_label_map(array)
    present = [int(value) for value in np.unique(ids) if value]
    unknown = [value for value in present if value not in segments]
    if unknown:
        raise PlgsError("unlisted", f"objects {listed(unknown)} are missing from {table}", array, _GROUNDED_FIX)
    return FoundMask(ids.astype(np.int32), tuple(segments[value] for value in present))


def _read_grounded(place: Path, names: Sequence[str], progress: Progress) -> MaskSource:
    arrays = _by_frame(place / "mask_data", ".npy")
    tables = _by_frame(place / "json_data", ".json")
    there = require_most(names, arrays, "mask", place / "mask_data", _GROUNDED_FIX)
    there = require_most(there, tables, "JSON of objects", place / "json_data", _GROUNDED_FIX)
    whole = of_most(there, lambda name: (whole_file(arrays[name]), whole_file(tables[name])), progress)
    objects = {name: _objects_of(tables[name]) for name in whole}
    label_of, labels = named_labels({word for found in objects.values() for word in found.values()})
    masks = {}
    for name, found in objects.items():
        segments = {number: FoundSegment(number, label_of[word], track=number) for number, word in found.items()}
        read = partial(_read_mask, arrays[name], tables[name].name, segments)
        masks[name] = StoredMask(arrays[name], label_map_size(arrays[name]), read)
    return MaskSource(masks, labels or None, tells_no_class=not labels)


def _by_frame(folder: Path, suffix: str) -> dict[str, Path]:
    """Return the files by frame; a file's name is "mask_" and the frame's name."""
    files = files_by_stem(folder, {suffix}, _GROUNDED_FIX)
    return {stem.removeprefix("mask_"): path for stem, path in files.items()}


def _objects_of(path: Path) -> dict[int, str]:
    """Return the class of each object's number. Raises PlgsError for a table of another form."""
    labels: Any = read_json_object(path).get("labels")
    if not isinstance(labels, dict):
        raise wrong_type("labels", "an object", labels, "the file", path)
    found = {}
    for key, entry in labels.items():
        if not isinstance(entry, dict):
            raise wrong_type(key[:20], "an object", entry, '"labels"', path)
        number = take_whole_number(entry, "instance_id", f"the object {key[:20]}", path)
        if not 1 <= number <= _LARGEST_OBJECT:
            raise PlgsError("bad-id", f"the object {key[:20]} has the number {number}", path, "Count objects from 1.")
        found[number] = take_text(entry, "class_name", f"the object {number}", path)
    return found


GROUNDED = MaskFormat(
    "grounded-sam2", lambda place: (place / "mask_data").is_dir() and (place / "json_data").is_dir(), _read_grounded,
    own_names=True,
)  # fmt: skip
