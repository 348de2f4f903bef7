"""What readers of mask formats return: segments with the files' own numbers and classes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from zlib import compress, decompress

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...job.progress import Progress
from ...posed.classes import ClassLabel
from ...posed.layout import shown, shown_size
from ..class_tables import is_thing_by_name
from ..frame import Size
from ..pixels import label_header, read_indices
from ..values import inside

LARGEST_TRACK = 2**31 - 1
"""The largest number of an object that is the same in several frames."""
IGNORED = frozenset({0, 255, 65535})  # labels that mean nothing in most label images, unless their table has them


@dataclass(frozen=True)
class FoundSegment:
    """A region of a stored mask: its value ``id`` >= 1 in the pixels, its class ``label`` in the masks' numbering, its
    score in 0..1. ``has_instance`` is False for the whole area of a class. ``track``: its object's id in all frames."""

    id: int
    label: int
    score: float = 1.0
    has_instance: bool = True
    track: int | None = None


@dataclass(frozen=True, eq=False)
class FoundMask:
    """A mask as found in files: segment ids, int32 [H, W] with 0 = void, and the segments."""

    ids: NDArray[np.int32]
    segments: tuple[FoundSegment, ...]


@dataclass(frozen=True, eq=False)
class StoredMask:
    """One frame's mask on disk: its file (for messages), its (width, height), and ``read``, which raises PlgsError."""

    path: Path
    size: Size
    read: partial[FoundMask]

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that ``read`` decodes."""
        given = (one if isinstance(one, tuple) else (one,) for one in self.read.args)
        return tuple(path for each in given for path in each if isinstance(path, Path))

    @property
    def about(self) -> str:
        """What the result of ``read`` depends on besides files, such as the segments listed in a table."""
        given = ((one, one if isinstance(one, tuple) and one else (one,)) for one in self.read.args)
        return repr([one for one, parts in given if not all(isinstance(part, Path) for part in parts)])


@dataclass(frozen=True)
class MaskSource:
    """All frames' masks. ``labels`` are the classes that their files name, None if they do not. ``stuff_in_pieces``:
    one stuff class may come as several segments of a frame. ``tells_no_class``: labels number objects, which without a
    table all have the class "object". Labels in ``void`` are ignored unless the table has them. ``table`` is what
    messages call the class table. ``kinds`` says whether each label is a thing, for files that give this without names.
    ``apart`` are the same masks, read as if their files numbered stuff separately from things."""

    masks: Mapping[str, StoredMask]
    labels: tuple[ClassLabel, ...] | None = None
    warnings: tuple[str, ...] = ()
    stuff_in_pieces: bool = False
    tells_no_class: bool = False
    void: frozenset[int] = frozenset({0})
    table: str = "the class table"
    kinds: Mapping[int, bool] | None = None
    apart: MaskSource | None = None


@dataclass(frozen=True)
class MaskFormat:
    """A format of masks by its ``name``, one of `MASK_FORMAT_NAMES`. ``recognises`` says whether a folder or file has
    it, by names, headers and first keys. ``read`` takes the frames' names and opens the masks without decoding a
    picture; it raises PlgsError. ``in_scene``: a scene's own folder is searched as well. ``own_names``: its files have
    distinctive names, so it is tried before formats with similar files."""

    name: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, Sequence[str], Progress], MaskSource]
    in_scene: bool = False
    own_names: bool = False


def segments_of_pairs(labels: NDArray[np.integer], instances: NDArray[np.integer]) -> FoundMask:
    """Make one segment for each pair of a class in ``labels`` [H, W] (< 0 = void) and an instance in ``instances`` [H,
    W] (<= 0 = none). Ids count from 1; those of class 0, which is void in most tables, come last."""
    pairs = labels.astype(np.int64) << 32 | np.maximum(instances, 0).astype(np.int64)
    present, inverse = np.unique(pairs, return_inverse=True)
    number = np.zeros(len(present), np.int32)
    segments: list[FoundSegment] = []
    for place in sorted(np.flatnonzero(present >= 0).tolist(), key=lambda place: (present[place] >> 32 == 0, place)):
        label, instance = int(present[place]) >> 32, int(present[place]) & 0xFFFFFFFF
        number[place] = len(segments) + 1
        segments.append(FoundSegment(len(segments) + 1, label, has_instance=instance != 0))
    return FoundMask(number[inverse.reshape(pairs.shape)], tuple(segments))


def segments_of_labels(labels: NDArray[np.integer]) -> FoundMask:
    """Make one segment for each class in ``labels`` [H, W] (< 0 = void). Each may be several objects."""
    return segments_of_pairs(labels, np.zeros_like(labels))


def painted(masks: Iterable[NDArray[np.bool_]], segments: Sequence[FoundSegment], size: Size) -> FoundMask:
    """Paint ``masks``, bool [H, W], one per segment, over each other, so that the highest score, then the smallest
    area, is on top. Masks are taken one at a time and kept packed, as a frame may have hundreds."""
    ids = np.zeros(size[::-1], np.int32)
    packed = [(np.count_nonzero(mask), compress(np.packbits(mask).tobytes(), 1)) for mask in masks]
    for place in sorted(range(len(packed)), key=lambda place: (segments[place].score, -packed[place][0])):
        bits = np.frombuffer(decompress(packed[place][1]), np.uint8)
        ids[np.unpackbits(bits, count=ids.size).reshape(ids.shape).view(np.bool_)] = segments[place].id
    seen = {*np.unique(ids).tolist()}
    return FoundMask(ids, tuple(segment for segment in segments if segment.id in seen))


def painted_files(paths: Sequence[Path], segments: Sequence[FoundSegment], size: Size, fix: str) -> FoundMask:
    """Paint the PNGs ``paths``, one per segment, over each other: the highest score, then the smallest, on top. Raises
    PlgsError for bad files and ones not of ``size`` (width, height)."""
    for path in paths:
        if label_header(path).size != size:
            raise PlgsError("other-size", f"this mask is not {shown_size(size)} like the others", path, fix)
    return painted((inside(read_indices(path), path) for path in paths), segments, size)


def pile(paths: Sequence[Path], segments: Sequence[FoundSegment], fix: str) -> StoredMask:
    """Return a frame's mask that is stored as one PNG per segment. Raises PlgsError if the first one is bad."""
    size = label_header(paths[0]).size
    return StoredMask(paths[0], size, partial(painted_files, (*paths,), segments, size, fix))


def named_labels(words: Collection[str]) -> tuple[dict[str, int], tuple[ClassLabel, ...]]:
    """Number classes that are given by name. Returns the label of each name, from 1, and the classes."""
    label_of = {word: number for number, word in enumerate(sorted({*words}), start=1)}
    labels = (ClassLabel(n, shown(word), is_thing_by_name(word) is not False) for word, n in label_of.items())
    return label_of, tuple(labels)
