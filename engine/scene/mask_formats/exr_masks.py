"""Masks from a renderer: Cryptomatte, and object index passes, one ``<frame>.exr`` per frame.

* Cryptomatte: a pixel shows the object that covers most of it, and is void if none covers half of it. Of several
  layers, that of instances, objects or assets is taken before one of materials, as their names tell. Classes are those
  of a layer of classes, else the names without the number at the end ("Chair.001"). Names are the same in all frames,
  and so are tracks.
* ``Object Index``, once ``IndexOB``: the object of each pixel, 0 = none; ``Material Index`` (``IndexMA``) beside it:
  its class. Without that, ``classes.toml`` may give each object's number a class. Cryptomatte comes before them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...gates import read_plain
from ...posed.exr_header import ExrHeader, read_exr_header
from ...posed.layout import file_inside, listed, shown
from ..exr_file import read_channels
from ..files_of_frames import files_of_frames
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
_INDEX = re.compile(r"(?:(.*)\.)?(?:(IndexOB|Object Index)|IndexMA|Material Index)(?:\.[XVYRxvyr])?")
_WORDS = ("instance", "object", "asset", "", "material", "mtl", "shader")
"""What a Cryptomatte's name may say that it shows, the best first; "" for those that do not say."""
_ALL_BITS = 2**32


@dataclass(frozen=True)
class Matte:
    """A Cryptomatte layer: its name, and the names in it by the 32 bits of each in the pixels."""

    name: str
    names: Mapping[int, str]


def _recognises_cryptomatte(place: Path) -> bool:
    header = _first_header(place)
    return header is not None and _has_cryptomatte(header)


def _has_cryptomatte(header: ExrHeader) -> bool:
    return any(key.startswith("cryptomatte/") for key in header.texts)


def _recognises_index(place: Path) -> bool:
    header = _first_header(place)
    return header is not None and _index_channels(header)[0] is not None and not _has_cryptomatte(header)


def _first_header(place: Path) -> ExrHeader | None:
    first = next(iter(sorted(place.glob("*.exr"))), None) if place.is_dir() else None
    return None if first is None else read_exr_header(first)


def _index_channels(header: ExrHeader) -> tuple[str | None, str | None, tuple[str, ...]]:
    """The channels of the objects' and of the materials' indices of the first view layer, and warnings."""
    objects, materials = dict[str, str](), dict[str, str]()
    for name in header.channels:
        if match := _INDEX.fullmatch(name):
            (objects if match[2] else materials).setdefault(match[1] or "", name)
    if not objects:
        return None, None, ()
    layer, *others = objects
    material = materials.get(layer, next(iter(materials.values()), None) if not others else None)
    unread = _quoted(objects[one] for one in others)
    warnings = (f'the objects are those of "{shown(objects[layer])}", not of {unread}',) if others else ()
    return objects[layer], material, warnings + _view_warnings(header)


def _view_warnings(header: ExrHeader) -> tuple[str, ...]:
    if len(header.views) < 2:
        return ()
    return (f'of the views of the masks, "{shown(header.views[0])}" is read, not {_quoted(header.views[1:])}',)


def _quoted(names: Iterable[str]) -> str:
    return listed([f'"{shown(name)}"' for name in names])


def _read_indices(place: Path, names: Sequence[str]) -> MaskSource:
    """Open object index passes; headers only. Raises PlgsError."""
    files = files_of_frames(place, names, {".exr"}, "mask", _FIX)
    headers = {name: read_exr_header(path) for name, path in files.items()}
    channels = {name: _index_channels(header) for name, header in headers.items()}
    without = [name for name, (_, materials, _) in channels.items() if materials is None]
    warnings = [each for *_, each in channels.values()]
    if 0 < len(without) < len(channels):
        warnings.append((f"masks without Material Index, so that no mask has classes: {listed(without)}",))
    masks = {}
    for name, (objects, materials, _) in channels.items():
        if objects is None:
            raise PlgsError("there is no channel Object Index or IndexOB", files[name], _FIX)
        chosen = [objects] if materials is None or without else [objects, materials]
        read = partial(_read_index, files[name], headers[name], chosen)
        masks[name] = StoredMask(files[name], headers[name].size, read)
    return MaskSource(masks, warnings=_once(warnings), tells_no_class=bool(without), void=IGNORED)


def _once(warnings: Iterable[Sequence[str]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(one for each in warnings for one in each))


def _read_index(path: Path, header: ExrHeader, names: list[str]) -> FoundMask:
    """One frame's indices of objects and, if there are any, of materials. Raises PlgsError."""
    channels = read_channels(path, header, names)
    indices, *labels = (np.rint(np.clip(np.nan_to_num(one), 0, 2**24)).astype(np.int64) for one in channels)
    for name, found in zip(names, (indices, *labels), strict=True):
        if found.max(initial=0) >= header.channels[name].exact:
            what = f'the numbers in "{shown(name)}" were rounded when the file was written'
            raise PlgsError(what, path, "Render as 32-bit floats without a compression that loses bits, such as ZIP.")
    return segments_of_pairs(labels[0], indices, tracked=True) if labels else segments_of_objects(indices)


def _read_cryptomattes(place: Path, names: Sequence[str]) -> MaskSource:
    """Open Cryptomattes; headers and manifests only. Raises PlgsError."""
    files = files_of_frames(place, names, {".exr"}, "mask", _FIX)
    headers = {name: read_exr_header(path) for name, path in files.items()}
    mattes = {name: _mattes(path, headers[name]) for name, path in files.items()}
    layers = {name: _chosen(mattes[name], path, headers[name]) for name, path in files.items()}
    _check_one_kind(files, {name: _rank(objects) for name, (objects, _) in layers.items()})
    words = {_class_name(classes or objects, bits, classes)
             for objects, classes in layers.values() for bits in (classes or objects).names}  # fmt: skip
    label_of, labels = named_labels(words)
    masks = {
        name: StoredMask(path, headers[name].size, partial(_read_matte, path, headers[name], *layers[name], label_of))
        for name, path in files.items()
    }
    warnings = _once(_warnings(headers[name], mattes[name], layers[name]) for name in files)
    return MaskSource(masks, labels, warnings, void=frozenset())


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


def _chosen(mattes: Sequence[Matte], path: Path, header: ExrHeader) -> tuple[Matte, Matte | None]:
    """The layers of objects and of classes, whose channels are there. Raises PlgsError."""
    classes = next((each for each in mattes if _word(each) == "class"), None)
    others = [each for each in mattes if each is not classes]
    if not others:
        raise PlgsError("there is no Cryptomatte of objects", path, _FIX)
    objects = min(others, key=lambda each: (_rank(each), each.name))
    for each in (objects, classes):
        if each is not None:
            _channels_of(path, header, each)
    return objects, classes


def _word(matte: Matte) -> str:
    """What a layer shows: the last of the known words in its name, as those of its view layer come first."""
    name = matte.name.casefold()
    return max(((name.rfind(word), word) for word in (*_WORDS, "class") if word and word in name), default=(0, ""))[1]


def _rank(matte: Matte) -> int:
    return _WORDS.index(_word(matte)) if _word(matte) in _WORDS else len(_WORDS)


def _check_one_kind(files: Mapping[str, Path], ranks: Mapping[str, int]) -> None:
    """Raise PlgsError when some frames have objects and others materials alone."""
    best = min(ranks.values(), default=0)
    odd = next((name for name, rank in ranks.items() if rank != best), None)
    if odd is not None:
        raise PlgsError("this frame lacks the Cryptomatte of objects that others have", files[odd], _FIX)


def _warnings(header: ExrHeader, mattes: Sequence[Matte], layers: tuple[Matte, Matte | None]) -> tuple[str, ...]:
    """What was chosen where a file leaves a choice."""
    objects, found = layers[0], []
    others = [each.name for each in mattes if each not in layers]
    if others:
        found.append(f'the objects are those of the Cryptomatte "{shown(objects.name)}", not of {_quoted(others)}')
    if _rank(objects) > _WORDS.index(""):
        found.append(f'"{shown(objects.name)}" is no Cryptomatte of objects: what shares a name in it is one object')
    if _index_channels(header)[0] is not None:
        found.append("Cryptomatte is read, not the object index: --mask-format object-index reads that")
    return (*found, *_view_warnings(header))


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


def _channels_of(path: Path, header: ExrHeader, matte: Matte) -> list[str]:
    """The channels of a layer's names and of what these cover. Raises PlgsError, also when names have lost bits."""
    wanted = f"{matte.name}00".casefold()
    layers = {name.rpartition(".")[0] for name in header.channels}
    found = [layer for layer in layers if layer.casefold() == wanted]
    if not found:  # one of both leaves out the view layer's name
        found = [one for one in layers if ("." in one) != ("." in wanted) and _last(one.casefold()) == _last(wanted)]
    known = {name.casefold(): name for name in header.channels}
    layer = f"{found[0]}.".casefold() if len(found) == 1 else ""
    pair = [known.get(layer + one, known.get(layer + two)) for one, two in (("r", "red"), ("g", "green"))]
    if not layer or pair[0] is None or pair[1] is None:
        raise PlgsError(f'the channels of "{shown(matte.name)}" are missing', path, _FIX)
    bits, covered = header.channels[pair[0]], pair[1]
    if not bits.is_float or bits.exact < _ALL_BITS:
        how = "compressed with a loss of bits" if bits.is_float else "not stored as 32-bit floats"
        fix = "Render with 32 bits (Color Depth: Float (Full)) and a lossless compression, such as ZIP."
        raise PlgsError(f'the Cryptomatte "{shown(matte.name)}" is {how}: 32 bits are needed', path, fix)
    return [pair[0], covered]


def _last(name: str) -> str:
    return name.rpartition(".")[2]


def _covering(path: Path, header: ExrHeader, matte: Matte) -> NDArray[np.int64]:
    """The bits of the name that covers at least half of each pixel, int64 [H, W], 0 = none. Raises PlgsError."""
    bits, covered = read_channels(path, header, _channels_of(path, header, matte))
    return np.where(covered >= _COVERED, np.ascontiguousarray(bits).view(np.uint32).astype(np.int64), 0)


CRYPTOMATTE = MaskFormat("cryptomatte", _recognises_cryptomatte, _read_cryptomattes)
OBJECT_INDEX = MaskFormat("object-index", _recognises_index, _read_indices)
