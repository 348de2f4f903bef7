"""A picture of segment ids and a JSON of its segments per frame: results of Hugging Face's and detectron2's networks.

``<frame>.json`` holds the list ``segments_info``, alone or under that name; beside it lies the picture of ids as
``<frame>.npy``, ``.npz`` or ``.png``. Neither library writes files itself; users save its results this way.

* transformers (``post_process_panoptic_segmentation``): ``{id, label_id, was_fused, score}``. Ids count from 1 with 0
  for nothing, or from 0 with -1 for nothing. One stuff class may come in pieces. The names are ``id2label`` of the
  model's ``config.json``, if that lies beside them.
* detectron2: ``{id, isthing, category_id, score}``; ids outside the list are void. ``category_id`` counts without gaps
  from 0 over all classes, or over things and stuff apart (Panoptic FPN on COCO, stuff from 1): then one number is a
  thing and a stuff class, or else the table that the user names decides (``numbering.py``)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import PlgsError
from ...job.progress import Progress, part_of
from ...json_file import (
    LARGEST_TABLE,
    parse_json_object,
    read_json_object,
    take_flag,
    take_objects,
    take_whole_number,
    whole_number,
)  # fmt: skip
from ...posed.classes import LARGEST_CLASS_ID, ClassLabel
from ...posed.layout import listed, read_file
from ..class_tables import is_thing_by_name, nearest_tables
from ..files_of_frames import files_of_frames, mask_files
from ..pixels import SUFFIXES, label_map_size, read_label_map
from .coco import take_score
from .source import FoundMask, FoundSegment, MaskFormat, MaskSource, StoredMask

_FIX = "Save for each frame the picture of ids (numpy.save, or PNG) and segments_info as JSON, both with its name."
_MOST_LOOKED_AT = 50
_CONFIG = "config.json"
_COCO_THINGS = 80


def _read_mask(picture: Path, table: str, segments: Mapping[int, FoundSegment]) -> FoundMask:
    """Read one frame's mask; ``segments`` are by id in the picture. Raises PlgsError for other ids."""
    ids = read_label_map(picture)
    present = np.unique(ids)
    void = {0, *([255, 65535] if picture.suffix.lower() == ".png" else [])}  # a PNG holds -1 as its largest value
    unknown = [value for value in present.tolist() if value >= 0 and value not in void and value not in segments]
    if unknown:
        fix = "Save picture and segments from the same call; with transformers, without label_ids_to_fuse."
        raise PlgsError("unlisted", f"segment ids {listed(unknown)} are missing from {table}", picture, fix)
    number = np.array([segments[int(v)].id if int(v) in segments else 0 for v in present], np.int32)
    painted = number[np.searchsorted(present, ids)]
    return FoundMask(painted, tuple(sorted(segments.values(), key=lambda segment: segment.id)))


def _key_of(place: Path) -> str | None:
    """Return the key of a segment's class, "label_id" or "category_id"; None if these are other files."""
    if not place.is_dir():
        return None
    found = mask_files(place, ".json")
    tables = [path for path in found if any(path.with_suffix(suffix).is_file() for suffix in SUFFIXES)]
    for path in tables[:_MOST_LOOKED_AT]:
        for info in _segments_info(path):
            return next((key for key in ("label_id", "category_id") if key in info), None)
    return "label_id" if tables else None


def _segments_info(path: Path) -> list[dict[str, Any]]:
    """Return a file's list of segments: its whole content, or "segments_info" in it. Raises PlgsError for no list."""
    data = read_file(path, LARGEST_TABLE)
    if data.lstrip().startswith(b"["):
        data = b'{"segments_info": ' + data + b"}"
    return take_objects(parse_json_object(data, path), "segments_info", "the file", path)


def _read_transformers(place: Path, names: Sequence[str], progress: Progress) -> MaskSource:
    pictures, tables = _files(place, names, progress)
    segments: dict[str, dict[int, FoundSegment]] = {name: {} for name in tables}
    fused = set()
    for name, table in tables.items():
        for info in _segments_info(table):
            _add(segments[name], _segment(info, "label_id", name, table), name, table)
            fused |= {info["label_id"]} if info.get("was_fused") else set()
    config = place / _CONFIG
    labels = labels_of_config(config, fused) if config.is_file() else None
    return MaskSource(_masks(pictures, tables, segments), labels, stuff_in_pieces=True, void=frozenset())


def _read_detectron2(place: Path, names: Sequence[str], progress: Progress) -> MaskSource:
    pictures, tables = _files(place, names, progress)
    infos = {name: _segments_info(table) for name, table in tables.items()}
    apart = _detectron2_source(pictures, tables, infos, is_apart=True)
    if _counts_stuff_apart(infos, tables):
        return apart
    return replace(_detectron2_source(pictures, tables, infos, is_apart=False), apart=apart)


def _detectron2_source(
    pictures: Mapping[str, Path], tables: Mapping[str, Path], infos: Mapping[str, list[dict[str, Any]]], is_apart: bool
) -> MaskSource:
    """Return the masks of the frames: ``pictures`` of ids, and the segments (``infos``) that the files ``tables`` list.
    With ``is_apart``, stuff is numbered separately, after COCO's things. Raises PlgsError for a bad id or class."""
    kinds: dict[int, bool] = {}
    segments: dict[str, dict[int, FoundSegment]] = {}
    for name in infos:
        segments[name] = {}
        for info in infos[name]:
            one = _segment(info, "category_id", name, tables[name])
            is_thing = take_flag(info, "isthing", f"segment {one.id} of frame {name}", tables[name])
            label = one.label + _COCO_THINGS - 1 if is_apart and not is_thing else one.label
            kinds.setdefault(label, is_thing)
            _add(segments[name], FoundSegment(one.id, label, one.score), name, tables[name])
    labels = tuple(ClassLabel(label, f"class {label}", kinds[label]) for label in sorted(kinds))
    return MaskSource(_masks(pictures, tables, segments), labels, void=frozenset(), kinds=kinds)


def _counts_stuff_apart(infos: Mapping[str, list[dict[str, Any]]], tables: Mapping[str, Path]) -> bool:
    """Whether the same number is a thing's class in one segment and a stuff class in another."""
    kinds = set()
    for name, found in infos.items():
        whose = f"a segment of frame {name}", tables[name]
        kinds |= {(take_whole_number(one, "category_id", *whose), take_flag(one, "isthing", *whose)) for one in found}
    return len({number for number, _ in kinds}) < len(kinds)


def _files(place: Path, names: Sequence[str], progress: Progress) -> tuple[dict[str, Path], dict[str, Path]]:
    first, second = part_of(progress, 0.0, 0.5), part_of(progress, 0.5, 1.0)
    pictures = files_of_frames(place, names, SUFFIXES, what="mask", fix=_FIX, progress=first)
    tables = files_of_frames(place, list(pictures), {".json"}, what="JSON of segments", fix=_FIX, progress=second)
    return {name: pictures[name] for name in tables}, tables


def _masks(
    pictures: Mapping[str, Path], tables: Mapping[str, Path], segments: Mapping[str, Mapping[int, FoundSegment]]
) -> dict[str, StoredMask]:
    masks = {}
    for name, path in pictures.items():
        read = partial(_read_mask, path, tables[name].name, segments[name])
        masks[name] = StoredMask(tables[name], label_map_size(path), read)
    return masks


def _segment(info: dict[str, Any], key: str, name: str, table: Path) -> FoundSegment:
    number = take_whole_number(info, "id", f"a segment of frame {name}", table)
    context = f"segment {number} of frame {name}"
    label = take_whole_number(info, key, context, table)
    if not 0 <= number < 2**24 or not 0 <= label < LARGEST_CLASS_ID:
        raise PlgsError("bad-id", f"{context} has an impossible id or class", table, "Save the library's own numbers.")
    return FoundSegment(number, label, take_score(info, context, table))


def _add(found: dict[int, FoundSegment], one: FoundSegment, name: str, table: Path) -> None:
    """Add ``one`` of frame ``name`` to the segments ``found``, with the next id. Fused stuff may come in pieces."""
    if one.id not in found:
        found[one.id] = FoundSegment(len(found) + 1, one.label, one.score)
    elif found[one.id].label != one.label:
        fix = "Post-process without label_ids_to_fuse: with it, transformers gives one id to several segments."
        raise PlgsError("segment-twice", f"frame {name} has the segment id {one.id} twice", table, fix)


def labels_of_config(config: Path, fused: Set[int] = frozenset()) -> tuple[ClassLabel, ...]:
    """The classes that ``id2label`` of a config.json names. Whether one is a thing follows from its name in public
    tables or else from ``fused``, the classes that were ever fused, which are stuff. Raises PlgsError without it."""
    names = read_json_object(config).get("id2label")
    fix = "Copy the model's config.json there, or remove it and name a table with --classes."
    if not isinstance(names, dict) or not names:
        raise PlgsError("no-id2label", 'the model\'s "id2label" is missing', config, fix, option="--classes")
    labels, tables = {}, nearest_tables(str(name) for name in names.values())
    for key, name in names.items():
        number = whole_number(key)
        if number is None or number > LARGEST_CLASS_ID or not isinstance(name, str) or not name.isprintable():
            what = f"the class {json.dumps(key)[:40]} of id2label is not a number with a name"
            raise PlgsError("bad-id2label", what, config, fix)
        is_thing = is_thing_by_name(name, tables)
        labels[number] = ClassLabel(number, name, number not in fused if is_thing is None else is_thing)
    return tuple(labels[key] for key in sorted(labels))


TRANSFORMERS = MaskFormat("transformers", lambda place: _key_of(place) == "label_id", _read_transformers)
DETECTRON2 = MaskFormat("detectron2", lambda place: _key_of(place) == "category_id", _read_detectron2)
