"""Masks from a renderer: Cryptomatte, and object index passes, one ``<frame>.exr`` per frame.

* Cryptomatte: a pixel shows the object that covers most of it, and is void if none covers half of it. A layer whose
  name has "object" or "instance" gives the objects. Their classes are those of a layer whose name has "class", else
  their names without the number at the end ("Chair.001"). Names are the same in all frames, and so are tracks.
* ``IndexOB``: the object of each pixel, 0 = none; ``IndexMA`` beside it: its class. Without that, ``classes.toml`` may
  give each object's number a class.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...gates import read_plain
from ...posed.exr_header import ExrHeader, read_exr_header
from ...posed.layout import file_inside, files_of_frames, shown
from ..exr_file import read_channels
from .source import (
    IGNORED,
    FoundMask,
    MaskFormat,
    MaskSource,
    StoredMask,
    named_labels,
    segments_of_objects,
    segments_of_pairs,
)

_FIX = "Render the frames with Cryptomatte, or with the object index pass, one file per frame."
_LARGEST_MANIFEST = 2**26
_COVERED = 0.5
_INDEX = re.compile(r"(?:.*\.)?(IndexOB|IndexMA)(?:\.[XVYRxvyr])?")


@dataclass(frozen=True)
class Matte:
    """A Cryptomatte layer: its name, and the names in it by the 32 bits of each in the pixels."""

    name: str
    names: Mapping[int, str]


def _recognises_cryptomatte(place: Path) -> bool:
    header = _first_header(place)
    return header is not None and any(key.startswith("cryptomatte/") for key in header.texts)


def _recognises_index(place: Path) -> bool:
    header = _first_header(place)
    return header is not None and _index_channels(header)[0] is not None


def _first_header(place: Path) -> ExrHeader | None:
    first = next(iter(sorted(place.glob("*.exr"))), None) if place.is_dir() else None
    return None if first is None else read_exr_header(first)


def _index_channels(header: ExrHeader) -> tuple[str | None, str | None]:
    """The channels of the objects' and of the materials' indices."""
    found = {match[1]: name for name in header.channels if (match := _INDEX.fullmatch(name))}
    return found.get("IndexOB"), found.get("IndexMA")


def _read_indices(place: Path, names: Sequence[str]) -> MaskSource:
    """Open object index passes; headers only. Raises PlgsError."""
    files = files_of_frames(place, names, {".exr"}, "mask", _FIX)
    headers = {name: read_exr_header(path) for name, path in files.items()}
    channels = {name: _index_channels(header) for name, header in headers.items()}
    has_classes = all(materials is not None for _, materials in channels.values())
    masks = {}
    for name, (objects, materials) in channels.items():
        if objects is None:
            raise PlgsError("there is no channel IndexOB", files[name], _FIX)
        read = partial(_read_index, files[name], headers[name], objects, materials if has_classes else None)
        masks[name] = StoredMask(files[name], headers[name].size, read)
    return MaskSource(masks, tells_no_class=not has_classes, void=IGNORED)


def _read_index(path: Path, header: ExrHeader, objects: str, materials: str | None) -> FoundMask:
    """One frame's indices of objects and, if there are any, of materials. Raises PlgsError."""
    channels = read_channels(path, header, [objects] if materials is None else [objects, materials])
    indices, *labels = (np.rint(np.clip(np.nan_to_num(one), 0, 2**24)).astype(np.int64) for one in channels)
    return segments_of_pairs(labels[0], indices, tracked=True) if labels else segments_of_objects(indices)


def _read_cryptomattes(place: Path, names: Sequence[str]) -> MaskSource:
    """Open Cryptomattes; headers and manifests only. Raises PlgsError."""
    files = files_of_frames(place, names, {".exr"}, "mask", _FIX)
    headers = {name: read_exr_header(path) for name, path in files.items()}
    layers = {name: _chosen(_mattes(path, headers[name]), path) for name, path in files.items()}
    words = {_class_name(classes or objects, bits, classes)
             for objects, classes in layers.values() for bits in (classes or objects).names}  # fmt: skip
    label_of, labels = named_labels(words)
    masks = {
        name: StoredMask(path, headers[name].size, partial(_read_matte, path, headers[name], *layers[name], label_of))
        for name, path in files.items()
    }
    return MaskSource(masks, labels, void=frozenset())


def _read_matte(
    path: Path, header: ExrHeader, objects: Matte, classes: Matte | None, label_of: Mapping[str, int]
) -> FoundMask:
    """One frame. ``label_of`` is the class of each name of the layer ``classes`` or, without it, ``objects``.

    Raises PlgsError.
    """
    instances = shown_bits = _covering(path, header, objects)
    if classes is not None:
        shown_bits = _covering(path, header, classes)
    present, inverse = np.unique(shown_bits, return_inverse=True)
    labels = [label_of[_class_name(classes or objects, int(one), classes)] if one else -1 for one in present]
    return segments_of_pairs(np.array(labels, np.int64)[inverse.reshape(instances.shape)], instances, tracked=True)


def _class_name(matte: Matte, bits: int, classes: Matte | None) -> str:
    """The class with these bits: its own name in a layer of classes, else the name without the number."""
    name = matte.names.get(bits, "unnamed")
    if classes is not None:
        return name
    return re.sub(r"[ ._#-]*\d+$", "", name).strip() or name


def _chosen(mattes: Sequence[Matte], path: Path) -> tuple[Matte, Matte | None]:
    """The layers of objects and of classes."""
    classes = next((each for each in mattes if "class" in each.name.casefold()), None)
    others = [each for each in mattes if each is not classes]
    if not others:
        raise PlgsError("there is no Cryptomatte of objects", path, _FIX)
    kinds = ("instance", "object")
    return next((each for each in others if any(kind in each.name.casefold() for kind in kinds)), others[0]), classes


def _mattes(path: Path, header: ExrHeader) -> list[Matte]:
    """The layers in a file. Bits 0 are called "unnamed", as unlisted bits are."""
    found = []
    for key, name in sorted(header.texts.items()):
        if key.startswith("cryptomatte/") and key.endswith("/name"):
            prefix = key.removesuffix("name")
            text = header.texts.get(prefix + "manifest") or _side_file(path, header.texts.get(prefix + "manif_file"))
            found.append(Matte(name, {0: "unnamed", **_manifest(text, path)}))
    return found


def _side_file(path: Path, name: str | None) -> str:
    """The manifest that lies beside the picture. Raises PlgsError."""
    if not name:
        return "{}"
    side = file_inside(path.parent, name, path)
    try:
        return read_plain(side, _LARGEST_MANIFEST).decode()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text"
        raise PlgsError(f"the manifest cannot be read ({reason})", side, "Put it beside the pictures.") from error


def _manifest(text: str, path: Path) -> dict[int, str]:
    try:
        content = json.loads(text)
        return {int(bits, 16): str(name) for name, bits in content.items()}
    except (ValueError, AttributeError, TypeError, RecursionError) as error:
        raise PlgsError("the Cryptomatte's manifest is damaged", path, "Render this frame again.") from error


def _covering(path: Path, header: ExrHeader, matte: Matte) -> NDArray[np.int64]:
    """The bits of the name that covers at least half of each pixel, int64 [H, W], 0 = none. Raises PlgsError."""
    known = {name.casefold(): name for name in header.channels}
    layer = f"{matte.name}00.".casefold()
    pair = [known.get(layer + one, known.get(layer + two)) for one, two in (("r", "red"), ("g", "green"))]
    if pair[0] is None or pair[1] is None:
        raise PlgsError(f'the channels of "{shown(matte.name)}" are missing', path, _FIX)
    bits, covered = read_channels(path, header, [pair[0], pair[1]])
    return np.where(covered >= _COVERED, np.ascontiguousarray(bits).view(np.uint32).astype(np.int64), 0)


CRYPTOMATTE = MaskFormat("cryptomatte", _recognises_cryptomatte, _read_cryptomattes)
OBJECT_INDEX = MaskFormat("object-index", _recognises_index, _read_indices)
