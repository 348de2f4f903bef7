"""Masks out of a renderer: Cryptomatte, and object index passes, one ``<frame>.exr`` a frame.

* Cryptomatte: what covers most of a pixel is its object; where nothing covers half of it, it is void. A layer whose
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
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...gates import read_plain
from ..class_tables import is_thing_by_name
from ..classes import ClassLabel
from ..frame import SceneError
from ..json_file import file_inside
from ..layout import files_by_stem, require_all, shown
from .exr_file import ExrHeader, read_channels, read_exr_header
from .painting import segments_of_pairs
from .source import IGNORED, FoundMask, FoundSegment, MaskSource

LOOKS_FOR_CRYPTOMATTE = "<frame>.exr with Cryptomatte"
LOOKS_FOR_INDEX = "<frame>.exr with the channel IndexOB"
_FIX = "Render the frames with Cryptomatte, or with the object index pass, one file a frame."
_LARGEST_MANIFEST = 2**26
_COVERED = 0.5
_INDEX = re.compile(r"(?:.*\.)?(IndexOB|IndexMA)(?:\.[XVYRxvyr])?")


@dataclass(frozen=True)
class Matte:
    """A Cryptomatte layer: its name, and the names in it by the 32 bits that stand for each in the pixels."""

    name: str
    names: Mapping[int, str]


@dataclass(frozen=True)
class MatteReader:
    """Reads one frame. ``label_of``: the class of each name of the layer ``classes`` or, where that is None, of the
    layer ``objects``."""

    path: Path
    header: ExrHeader
    objects: Matte
    classes: Matte | None
    label_of: Mapping[str, int]

    def __call__(self) -> FoundMask:
        """The mask. Raises SceneError for a bad file."""
        bits, covered = _first_rank(self.path, self.header, self.objects)
        objects = np.where(covered >= _COVERED, bits, 0)
        if self.classes is None:
            return segments_of_pairs(self._labels(objects, self.objects), objects, tracked=True)
        bits, covered = _first_rank(self.path, self.header, self.classes)
        labels = self._labels(np.where(covered >= _COVERED, bits, 0), self.classes)
        return segments_of_pairs(labels, objects, tracked=True)

    def _labels(self, bits: NDArray[np.int64], matte: Matte) -> NDArray[np.int64]:
        """The class of each pixel, int64 [H, W], -1 = none."""
        present, inverse = np.unique(bits, return_inverse=True)
        labels = [-1 if not one else self.label_of[_class_name(matte, int(one), self.classes)] for one in present]
        return np.array(labels, np.int64)[inverse.reshape(bits.shape)]


@dataclass(frozen=True)
class IndexReader:
    """Reads one frame's indices of objects and, where there are any, of materials."""

    path: Path
    header: ExrHeader
    objects: str
    materials: str | None

    def __call__(self) -> FoundMask:
        """The mask. Raises SceneError for a bad file."""
        names = [self.objects] if self.materials is None else [self.objects, self.materials]
        channels = read_channels(self.path, self.header, names)
        objects, *materials = (np.rint(np.clip(np.nan_to_num(one), 0, 2**24)).astype(np.int64) for one in channels)
        if materials:
            return segments_of_pairs(materials[0], objects, tracked=True)
        found = [int(value) for value in np.unique(objects) if value]
        return FoundMask(objects.astype(np.int32), tuple(FoundSegment(one, one, track=one) for one in found))


def recognises_cryptomatte(place: Path) -> bool:
    header = _first_header(place)
    return header is not None and any(key.startswith("cryptomatte/") for key in header.texts)


def recognises_index(place: Path) -> bool:
    header = _first_header(place)
    return header is not None and _index_channels(header)[0] is not None


def _first_header(place: Path) -> ExrHeader | None:
    first = next(iter(sorted(place.glob("*.exr"))), None) if place.is_dir() else None
    return None if first is None else read_exr_header(first)


def _index_channels(header: ExrHeader) -> tuple[str | None, str | None]:
    """The channels of the objects' and of the materials' indices."""
    found = {match[1]: name for name in header.channels if (match := _INDEX.fullmatch(name))}
    return found.get("IndexOB"), found.get("IndexMA")


def read_index(place: Path, names: Sequence[str]) -> MaskSource:
    """Open object index passes; headers only. Raises SceneError."""
    files, headers = _open(place, names)
    readers: dict[str, IndexReader] = {}
    for name in names:
        objects, materials = _index_channels(headers[name])
        if objects is None:
            raise SceneError("there is no channel IndexOB", files[name], _FIX)
        readers[name] = IndexReader(files[name], headers[name], objects, materials)
    has_classes = all(reader.materials is not None for reader in readers.values())
    if not has_classes:
        readers = {name: IndexReader(one.path, one.header, one.objects, None) for name, one in readers.items()}
    sizes = {name: headers[name].size for name in names}
    return MaskSource(None, readers, sizes, files, tells_no_class=not has_classes, void=IGNORED)


def read_cryptomatte(place: Path, names: Sequence[str]) -> MaskSource:
    """Open Cryptomattes; headers and manifests only. Raises SceneError."""
    files, headers = _open(place, names)
    layers = {name: _chosen(_mattes(files[name], headers[name]), files[name]) for name in names}
    words = sorted({_class_name(*each) for layer in layers.values() for each in _all_names(*layer)})
    label_of = {word: number for number, word in enumerate(words, start=1)}
    readers = {name: MatteReader(files[name], headers[name], *layers[name], label_of) for name in names}
    labels = [ClassLabel(label_of[word], shown(word), is_thing_by_name(word) is not False) for word in words]
    return MaskSource(
        labels=tuple(labels),
        readers=readers,
        sizes={name: headers[name].size for name in names},
        paths=files,
        void=frozenset(),
    )


def _open(place: Path, names: Sequence[str]) -> tuple[dict[str, Path], dict[str, ExrHeader]]:
    files = files_by_stem(place, {".exr"}, _FIX)
    require_all(names, files, "mask", place, _FIX)
    return {name: files[name] for name in names}, {name: read_exr_header(files[name]) for name in names}


def _all_names(objects: Matte, classes: Matte | None) -> list[tuple[Matte, int, Matte | None]]:
    matte = objects if classes is None else classes
    return [(matte, bits, classes) for bits in matte.names]


def _class_name(matte: Matte, bits: int, classes: Matte | None) -> str:
    """The class of what has these bits: its own name in a layer of classes, else the name without the number."""
    name = matte.names.get(bits, "unnamed")
    if classes is not None:
        return name
    return re.sub(r"[ ._#-]*\d+$", "", name).strip() or name


def _chosen(mattes: Sequence[Matte], path: Path) -> tuple[Matte, Matte | None]:
    """The layers of objects and of classes."""
    classes = next((each for each in mattes if "class" in each.name.casefold()), None)
    others = [each for each in mattes if each is not classes]
    if not others:
        raise SceneError("there is no Cryptomatte of objects", path, _FIX)
    kinds = ("instance", "object")
    return next((each for each in others if any(kind in each.name.casefold() for kind in kinds)), others[0]), classes


def _mattes(path: Path, header: ExrHeader) -> list[Matte]:
    """The layers in a file, with 0 and unlisted bits left to be "unnamed"."""
    found = []
    for key, name in sorted(header.texts.items()):
        if key.startswith("cryptomatte/") and key.endswith("/name"):
            prefix = key.removesuffix("name")
            text = header.texts.get(prefix + "manifest") or _side_file(path, header.texts.get(prefix + "manif_file"))
            found.append(Matte(name, {0: "unnamed", **_manifest(text, path)}))
    return found


def _side_file(path: Path, name: str | None) -> str:
    """The manifest that lies beside the picture. Raises SceneError."""
    if not name:
        return "{}"
    side = file_inside(path.parent, name, path)
    try:
        return read_plain(side, _LARGEST_MANIFEST).decode()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise SceneError(f"the manifest cannot be read ({reason})", side, "Put it beside the pictures.") from error


def _manifest(text: str, path: Path) -> dict[int, str]:
    try:
        content = json.loads(text)
        return {int(bits, 16): str(name) for name, bits in content.items()}
    except (ValueError, AttributeError, TypeError, RecursionError) as error:
        raise SceneError("the Cryptomatte's manifest is damaged", path, "Render this frame again.") from error


def _first_rank(path: Path, header: ExrHeader, matte: Matte) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The bits of what covers most of each pixel, int64 [H, W], and how much of it, float32 [H, W]."""
    known = {name.casefold(): name for name in header.channels}
    layer = f"{matte.name}00.".casefold()
    pair = [known.get(layer + one, known.get(layer + two)) for one, two in (("r", "red"), ("g", "green"))]
    if pair[0] is None or pair[1] is None:
        raise SceneError(f'the channels of "{shown(matte.name)}" are missing', path, _FIX)
    bits, covered = read_channels(path, header, [pair[0], pair[1]])
    return np.ascontiguousarray(bits).view(np.uint32).astype(np.int64), covered
