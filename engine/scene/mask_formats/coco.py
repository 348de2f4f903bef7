"""COCO panoptic masks: one JSON table, and one PNG per frame, id = R + 256 G + 65536 B.

Exporters differ: a missing score counts as 1, ``label_id`` (transformers) as ``category_id``, and a palette-free grey
PNG holds the ids themselves. Tables that would silently mix up segments are refused. Class ids are the category ids; a
table that uses 0, which is void here, is shifted by one as a whole, in ground truth too."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...job.progress import part_of
from ...json_file import (
    read_json_object,
    take_flag,
    take_list,
    take_number,
    take_objects,
    take_text,
    take_whole_number,
    wrong_type,
)  # fmt: skip
from ...posed.classes import LARGEST_CLASS_ID, ClassLabel
from ...posed.image_header import read_image_header
from ...posed.layout import LARGEST_PIXELS, composed, file_inside, listed, of_most, require_most
from ..class_tables import is_thing_by_name
from ..files_of_frames import of_same_name, whole_file
from ..pixels import decode, distinct_ids
from ..values import checked_ids
from ..view import Progress, watched
from .source import FoundMask, FoundSegment, MaskFormat, MaskSource, StoredMask

_LARGEST_SEGMENT_ID = 256**3 - 1  # the ids are R + 256 G + 65536 B


def _read_mask(png: Path, table: str, segments: tuple[FoundSegment, ...], crowd_ids: frozenset[int]) -> FoundMask:
    """Read one frame's mask with these ``segments``; segments in ``crowd_ids``, which are uncounted objects, become
    void. ``table`` is the JSON's name, for messages."""
    ids = _read_ids(png)
    found, _ = distinct_ids(ids)
    unknown = sorted({*found.tolist()} - {0} - {segment.id for segment in segments} - crowd_ids)
    if unknown:
        checked_ids(ids, png)  # if a filter has mixed the ids, this says so
        fix = "Add them to this frame's segments_info, or paint them 0 (id = R + 256 G + 65536 B)."
        raise PlgsError("unlisted", f"segment ids {listed(unknown)} of the PNG are missing from {table}", png, fix)
    if crowd_ids:
        ids[np.isin(ids, list(crowd_ids))] = 0
    return FoundMask(ids, segments)


def _read_ids(png: Path) -> NDArray[np.int32]:
    """Read the segment ids that a PNG stores in grey values or in its colours, int32 [H, W]."""
    pixels = decode(png, as_colour=False)
    if pixels.ndim == 2:
        return pixels.astype(np.int32)
    if pixels.dtype != np.uint8 or pixels.shape[2] < 3:
        raise PlgsError("mask-png", "the mask is not an 8-bit RGB PNG", png, "Save ids as R + 256 G + 65536 B.")
    ids = pixels[..., 0].astype(np.int32)
    for channel in (1, 2):
        ids += pixels[..., channel].astype(np.int32) << 8 * channel
    return ids


def _table_of(place: Path) -> Path:
    return place if place.suffix.lower() == ".json" else place / "panoptic.json"


def _read(place: Path, names: Sequence[str], progress: Progress) -> MaskSource:
    """Open the JSON at ``place``, or panoptic.json in it. Its folder of PNGs has the JSON's stem."""
    table = _table_of(place)
    content = read_json_object(table)
    labels = read_categories(content, table)
    if not labels:
        raise PlgsError("no-classes", "the COCO JSON lists no categories", table, "List the classes of the masks.")
    folder = table.with_suffix("")
    if not folder.is_dir():
        what = "the folder of mask images is missing"
        raise PlgsError("no-folder", what, folder, f"Put the PNGs of {table.name} there.")
    entries = of_same_name(names, _entries_by_frame(content, table, names))
    fix = "Add an annotation whose file name has the colour image's stem."
    there = require_most(names, entries, "mask", table, fix)
    inside = {name: file_inside(folder, entries[name]["file_name"], table) for name in there}
    pictures = of_most(there, lambda name: whole_file(inside[name]), part_of(progress, 0.0, 0.3))
    known = frozenset(label.id for label in labels)
    masks, crowded = {}, []
    for name, png in watched([*pictures.items()], part_of(progress, 0.3, 1.0)):
        masks[name], has_crowds = _open_frame(entries[name], name, png, table, known)
        crowded += [name] * has_crowds
    warnings = (f"crowd segments (iscrowd) count as void: {listed(crowded)}",) if crowded else ()
    return MaskSource(masks, labels, warnings)


def read_categories(
    content: dict[str, Any], table: Path, key: str = "categories", kind: str = "isthing", *, may_lack: bool = False
) -> tuple[ClassLabel, ...]:
    """The classes that a table lists under ``key``, by ascending id. ``kind`` is the key that says whether a class is a
    thing; if classes ``may_lack`` it, their name decides. Raises PlgsError for a repeated or impossible id."""
    found: dict[int, ClassLabel] = {}
    for position, entry in enumerate(take_objects(content, key, "the file", table)):
        context = f"category {position}"
        number, name = take_whole_number(entry, "id", context, table), take_text(entry, "name", context, table)
        if not 0 <= number <= LARGEST_CLASS_ID:
            what = f"the category id {number} is out of range"
            raise PlgsError("class-id", what, table, f"Use ids from 1 to {LARGEST_CLASS_ID}.")
        if number in found:
            what = f"the category id {number} occurs twice"
            raise PlgsError("class-twice", what, table, "Give each category its own id.")
        guessed = is_thing_by_name(name) is not False if may_lack and kind not in entry else None
        is_thing = take_flag(entry, kind, context, table) if guessed is None else guessed
        found[number] = ClassLabel(number, name, is_thing, _colour(entry, context, table))
    return tuple(found[number] for number in sorted(found))


def _colour(entry: dict[str, Any], context: str, table: Path) -> tuple[int, int, int] | None:
    if "color" not in entry:
        return None
    value = take_list(entry, "color", context, table)
    if len(value) != 3 or not all(type(part) is int and 0 <= part <= 255 for part in value):
        raise wrong_type("color", "three whole numbers 0..255", value, context, table)
    return value[0], value[1], value[2]


def _entries_by_frame(content: dict[str, Any], table: Path, names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the annotation of each frame, found by its image's file name or, failing that, by its mask's."""
    images = images_of(content, table)
    wanted, found = {*names}, dict[str, dict[str, Any]]()
    for position, entry in enumerate(take_objects(content, "annotations", "the file", table)):
        stem = stem_of(take_text(entry, "file_name", f"annotation {position}", table))
        name = images.get(str(entry.get("image_id")), stem)
        name = name if name in wanted else stem
        if name in found:
            raise PlgsError("frame-twice", f"frame {name} has two annotations", table, "Keep one annotation per frame.")
        found[name] = entry
    return found


def images_of(content: dict[str, Any], table: Path) -> dict[str, str]:
    """Return the stem of each image's file, by the image's id as text. Raises PlgsError for names that are no text."""
    images: dict[str, str] = {}
    for position, image in enumerate(take_objects(content, "images", "the file", table) if "images" in content else ()):
        named = next((key for key in ("file_name", "coco_url") if key in image), None)  # LVIS has only the latter
        if "id" in image and named is not None:
            images[str(image["id"])] = stem_of(take_text(image, named, f"image {position}", table))
    return images


def stem_of(file_name: str) -> str:
    """Return a file name without folders (of Windows or POSIX) and without its suffix."""
    return composed(file_name.replace("\\", "/").rsplit("/", 1)[-1].rsplit(".", 1)[0])


def _open_frame(
    entry: dict[str, Any], name: str, png: Path, table: Path, known: frozenset[int]
) -> tuple[StoredMask, bool]:
    context = f"the annotation of frame {name}"
    header = read_image_header(png)
    if header.width * header.height > LARGEST_PIXELS:
        what = f"{header.width}x{header.height} is too large for a mask"
        raise PlgsError("mask-too-large", what, png, "Write this file again.")
    if header.format != "png" or header.bit_depth < 8:
        what = "masks must be PNGs of 8 or 16 bits per channel"
        raise PlgsError("mask-png", what, png, "Save ids as R + 256 G + 65536 B.")
    segments: dict[int, FoundSegment] = {}
    crowd_ids: set[int] = set()
    for info in take_objects(entry, "segments_info", context, table):
        segment = _segment(info, name, table, known)
        if segment.id in segments or segment.id in crowd_ids:
            fix = "Give each segment its own id; with transformers, post-process without label_ids_to_fuse."
            raise PlgsError("segment-twice", f"frame {name} has the segment id {segment.id} twice", table, fix)
        if "iscrowd" in info and take_flag(info, "iscrowd", f"segment {segment.id} of frame {name}", table):
            crowd_ids.add(segment.id)
        else:
            segments[segment.id] = segment
    ordered = tuple(segments[key] for key in sorted(segments))
    read = partial(_read_mask, png, table.name, ordered, frozenset(crowd_ids))
    return StoredMask(png, header.size, read), bool(crowd_ids)


def _segment(info: dict[str, Any], name: str, table: Path, known: frozenset[int]) -> FoundSegment:
    segment_id = take_whole_number(info, "id", f"a segment of frame {name}", table)
    context = f"segment {segment_id} of frame {name}"
    if not 1 <= segment_id <= _LARGEST_SEGMENT_ID:
        what = f"{context} has an id that a PNG cannot hold"
        raise PlgsError("segment-id", what, table, "Number segments from 1; 0 is void.")
    key = "label_id" if "category_id" not in info and "label_id" in info else "category_id"  # as in transformers
    category_id = take_whole_number(info, key, context, table)
    if category_id not in known:
        what = f"{context} has the category id {category_id}, which is not in the categories"
        raise PlgsError("no-such-class", what, table, "Add the category, or correct the id.")
    return FoundSegment(segment_id, category_id, take_score(info, context, table))


def take_score(info: dict[str, Any], context: str, table: Path) -> float:
    """Return a segment's score, the detector's confidence; 1 if there is none."""
    return 1.0 if info.get("score") is None else take_number(info, "score", context, table, least=0.0, most=1.0)


FORMAT = MaskFormat("coco", lambda place: _table_of(place).is_file(), _read, in_scene=True, own_names=True)
