"""Check that masks fit their pictures: paired with the right frames, upright as stored, undistorted, without borders.

Programs renumber masks, rotate photos by their EXIF tag, keep the photo's distortion, or pad to a network's input size.
Names and sizes do not show it, but pixels do: the outlines of a mask should lie on edges of its picture."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..posed.frames import Camera
from ..posed.layout import fits_picture, listed, same_shape, shown_size
from .formats.lens import Distortion, undistorted
from .frame import Inferred, Size
from .frame_choice import evenly_spread
from .frame_colours import borders
from .mask_formats import MaskSource
from .pixels import opaque, read_indices, resize_nearest
from .values import inside

Ids = NDArray[np.int32]
Read = Callable[[Size], NDArray[np.uint8]]  # reads a picture at a size
_LOOKED_AT = 16
_LONGEST = 320  # pixels of the longer side at which pictures are compared
_LEAST_OUTLINE = 30
_BLACK = 12
_SURE = 4.0
"""Standard errors of the mean difference by which one reading must fit better than another. On the sample, masks of the
next frame differ by 15, masks distorted by 5 pixels by 8, and those distorted by 2 pixels not at all."""
_LEAST_PICTURES = 6  # pictures in which the readings must fit differently: 3 seem sure by chance in 6 % of cases
_NETWORK_STEP = 32  # networks take pictures whose sides are multiples of this
_FIX = "Give masks of these pictures with --masks FOLDER: python -m engine segment SCENE makes them."
_TURNS = {3: 2, 6: 1, 8: 3}  # counter-clockwise quarter turns from upright to stored pictures, by EXIF orientation
_BY_NAMES = "rename the masks after their pictures if that is wrong"


@dataclass(frozen=True)
class Placement:
    """How a mask is mapped into the stored, undistorted picture: the ``box`` (x, y, width, height) of it that is used,
    its ``turns`` by 90 degrees, the ``lens`` whose distortion is removed, and ``kept``, the pixels that count."""

    box: tuple[int, int, int, int] | None = None
    turns: int = 0
    lens: tuple[Camera, Distortion] | None = None
    kept: KeptPixels | None = None

    def __call__(self, ids: NDArray[Any]) -> NDArray[Any]:
        """Map stored ids, or other values [H, W], into the picture. Raises PlgsError if little of it is left."""
        if self.box is not None:
            x, y, width, height = self.box
            ids = ids[y : y + height, x : x + width]
        ids = np.rot90(ids, self.turns)
        if self.lens is not None:
            ids = undistorted(ids, *self.lens, Path(), smooth=False)
        if self.kept is not None:
            ids = np.where(self.kept((ids.shape[1], ids.shape[0])), ids, 0)
        return np.ascontiguousarray(ids)

    def __repr__(self) -> str:
        """Return a text for the digests of masks, which changes with the placement."""
        lens = None if self.lens is None else (self.lens[0].K.tolist(), self.lens[1])
        return f"{self.box} {self.turns} {lens} {self.kept}"


@dataclass(frozen=True)
class KeptPixels:
    """The pixels of a frame that count. ``path`` is a picture like the photo as taken with the photo's ``lens``; its
    black pixels do not count. With ``is_photo``, it is the photo itself, whose transparent pixels do not count."""

    path: Path
    lens: tuple[Camera, Distortion] | None = None
    is_photo: bool = False

    def __call__(self, size: Size) -> NDArray[np.bool_]:
        """Return the pixels that count, bool [H, W], at ``size`` (width, height). Raises PlgsError for a bad file."""
        kept = opaque(self.path) if self.is_photo else inside(read_indices(self.path), self.path)
        if self.lens is not None:
            kept = undistorted(kept.astype(np.uint8), *self.lens, self.path, smooth=False) > 0
        return resize_nearest(kept, size)

    def __repr__(self) -> str:
        return f"{self.path.name} {self.path.stat().st_size if self.path.exists() else 0}"


def edge_ranks(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Rank the pixels of a picture by the strength of their edge: the fraction of pixels with a weaker one, float32 [H,
    W]; NaN in and around black areas, such as those beyond the edges of an undistorted photo."""
    import cv2

    grey = cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    strength = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)).ravel()
    ranks = np.empty(strength.size, np.float32)
    ranks[np.argsort(strength)] = np.linspace(0.0, 1.0, strength.size, dtype=np.float32)
    black = (picture.max(axis=2) <= _BLACK).astype(np.uint8)
    return np.where(cv2.dilate(black, np.ones((9, 9), np.uint8)) > 0, np.nan, ranks.reshape(grey.shape))


def on_edges(ids: Ids, ranks: NDArray[np.float32]) -> float:
    """Return the mean of ``edge_ranks`` [H, W] on a mask's outlines: 0.5 by chance, NaN with hardly any outline."""
    height, width = ranks.shape
    ids = resize_nearest(ids, (width, height))
    outline = borders(ids)
    outline[:2] = outline[-2:] = outline[:, :2] = outline[:, -2:] = False  # sides of the picture
    outline &= np.isfinite(ranks)
    return float(ranks[outline].mean()) if outline.sum() >= _LEAST_OUTLINE else float("nan")


def fits_better(pairs: Iterable[tuple[Ids, Ids, Read, Size]]) -> bool | None:
    """Whether the first of two readings of ids fits the pictures better: True, False for the second, None if unsure.
    Each pair of ids [H, W] comes with a function that reads the frame's picture, and a size."""
    differences = []
    for one, other, read, size in pairs:
        if one.shape == other.shape and np.array_equal(one, other):
            continue
        scale = min(1.0, _LONGEST / max(size))
        ranks = edge_ranks(read((round(size[0] * scale), round(size[1] * scale))))
        differences.append(on_edges(one, ranks) - on_edges(other, ranks))
    found = np.array([each for each in differences if np.isfinite(each)])
    if len(found) < _LEAST_PICTURES:
        return None
    error = max(float(found.std(ddof=1)) / np.sqrt(len(found)), 1e-6)
    return None if abs(found.mean()) < _SURE * error else bool(found.mean() > 0.0)


def _ids(source: MaskSource, name: str) -> Ids | None:
    """Return the ids [H, W] of the frame ``name``'s mask, None if it cannot be read; later readers report that."""
    try:
        return source.masks[name].read().ids
    except PlgsError:
        return None


def paired(
    names: Sequence[str], open_source: Callable[[Sequence[str]], MaskSource], pictured: Mapping[str, Pictured]
) -> tuple[MaskSource, tuple[Inferred, ...]]:
    """Pair masks with the frames ``names``: by name, or by numbers counted otherwise if more frames then have a mask
    and these fit the pictures better. Returns the masks, and what was inferred. ``open_source`` opens the masks of such
    names; what it raises is raised."""
    try:
        usual, error = open_source(names), None
    except PlgsError as raised:
        usual, error = MaskSource({}), raised
    lacking = [name for name in names if name not in usual.masks]
    if not lacking or (error is not None and error.key != "lacks-files"):
        if error is not None:
            raise error
        return usual, ()
    ways = []
    for how, others in other_numbers(names):
        try:
            source = open_source([*others.values()])
        except PlgsError:
            continue
        masks = {name: source.masks[other] for name, other in others.items() if other in source.masks}
        if len(masks) > len(usual.masks):
            ways.append((how, replace(source, masks=masks)))
    doubts: tuple[Inferred, ...] = ()
    for how, source in sorted(ways, key=lambda way: -len(way[1].masks)):
        chosen = source.masks
        # If no mask has a picture's name, the pairs must fit better than the masks of the next frames do.
        moved = dict(zip(names, [*chosen.values()][1:], strict=False))
        against = usual if usual.masks else replace(source, masks=moved)
        common = evenly_spread([name for name in chosen if name in against.masks], _LOOKED_AT)
        read = ((_ids(source, name), _ids(against, name), pictured[name]) for name in common)
        pairs = ((one, other, shown) for one, other, shown in read if one is not None and other is not None)
        fits = fits_better((one, other, shown.read, shown.size) for one, other, shown in pairs)
        if fits:
            what = f"{how}: {names[0]} has {chosen[names[0]].path.name if names[0] in chosen else 'none'}"
            return source, (Inferred("numbering", f"masks are paired with frames {what}", f"they fit so; {_BY_NAMES}"),)
        if fits is None and error is None:
            what = f"masks may be numbered otherwise than frames: {listed(lacking)} have no mask, some masks no frame"
            doubts = (Inferred("numbering", what, "the pictures do not show it; if so, rename the masks"),)
    if error is not None:
        raise error
    return usual, doubts


def other_numbers(names: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """Return other ways to number the frames' masks: for each, a description, and the mask's name by frame."""
    last = [re.search(r"\d+(?=\D*$)", name) for name in names]
    found = [(name, match) for name, match in zip(names, last, strict=True) if match is not None]
    if len(found) < len(names):
        return []

    widths = {len(at[0]) for _, at in found}
    width = max(widths) if len(widths) == 1 else 1  # 0008 and 0013, or 8 and 13

    def renamed(number: Callable[[int, int], int]) -> dict[str, str]:
        return {
            name: f"{name[: at.start()]}{number(int(at[0]), i):0{width}d}{name[at.end() :]}"
            for i, (name, at) in enumerate(found)
            if number(int(at[0]), i) >= 0
        }

    return [
        ("whose number is one less", renamed(lambda number, _: number + 1)),
        ("whose number is one more", renamed(lambda number, _: number - 1)),
        ("by their order, counted from 0", renamed(lambda _, place: place)),
        ("by their order, counted from 1", renamed(lambda _, place: place + 1)),
    ]


@dataclass(frozen=True)
class Pictured:
    """What a frame's masks are aligned by: how to read its picture, the picture's size, the photo's EXIF orientation (1
    is upright), the lens that distorted it, if any, and the pixels that count (``kept``), None if all do."""

    read: Read
    size: Size
    orientation: int = 1
    lens: tuple[Camera, Distortion] | None = None
    kept: KeptPixels | None = None


def turns_of(orientation: int) -> int:
    """Return the turns by 90 degrees from an upright photo to its pixels as stored, for an EXIF orientation."""
    return _TURNS.get(orientation, 0)


def placements(
    source: MaskSource, pictured: Mapping[str, Pictured]
) -> tuple[dict[str, Placement], tuple[Inferred, ...]]:
    """Return how to map each frame's mask into its picture, and what was inferred. Raises PlgsError if a mask's aspect
    ratio differs from its picture's."""
    found = {name: Placement(kept=pictured[name].kept) for name in source.masks}
    inferred: list[Inferred] = []
    turned = {name for name in found if turns_of(pictured[name].orientation)}
    turns = {name: replace(found[name], turns=turns_of(pictured[name].orientation)) for name in turned}
    sideways = {  # a square one has the right size in both orientations; its content decides
        name for name in turned
        if turns[name].turns % 2
        and same_shape(source.masks[name].size[::-1], pictured[name].size)
        and not same_shape(source.masks[name].size, pictured[name].size)
    }  # fmt: skip
    fits = len(sideways) == len(turned) or _fits(source, turns, found, pictured)
    if turned and fits:
        found |= turns
        what = f"masks of photos with an EXIF orientation are turned to the stored pictures ({listed(sorted(turned))})"
        inferred.append(Inferred("orientation", what, "they fit so"))
    elif turned and fits is None:
        what = f"photos with an EXIF orientation are read as they are stored ({listed(sorted(turned))})"
        inferred.append(Inferred("orientation", what, "poses and depth are of the stored pictures; so must masks be"))
    boxes = _boxes(source, found, pictured)
    if boxes:
        found |= {name: replace(found[name], box=box) for name, box in boxes.items()}
        name, box = next(iter(boxes.items()))
        what = f"masks of {shown_size(source.masks[name].size)} are cut to {shown_size(box[2:])}, without their borders"
        inferred.append(Inferred("masks' borders", what, "networks add such borders, and the masks are empty there"))
    for name, placement in found.items():
        width, height = source.masks[name].size if placement.box is None else placement.box[2:]
        size = (height, width) if placement.turns % 2 else (width, height)
        if not fits_picture(size, pictured[name].size):
            what = f"a mask of {shown_size(size)} does not fit the colour image of {shown_size(pictured[name].size)}"
            raise PlgsError("mask-shape", what, source.masks[name].path, _FIX, option="--masks")
    bent = {name: replace(one, lens=pictured[name].lens) for name, one in found.items() if pictured[name].lens}
    if bent and _fits(source, bent, found, pictured):
        found |= bent
        what = "masks are straightened as the photos are"
        inferred.append(Inferred("masks' lens", what, "they fit the photos as taken"))
    return found, tuple(inferred)


def _fits(
    source: MaskSource, ones: Mapping[str, Placement], others: Mapping[str, Placement], pictured: Mapping[str, Pictured]
) -> bool | None:
    """Whether the placements ``ones`` fit the pictures better than ``others``: True, False, or None if unsure."""
    names = evenly_spread([*ones], _LOOKED_AT)
    read = ((name, ids) for name in names if (ids := _ids(source, name)) is not None)
    ways = [{name: replace(way[name], kept=None) for name in names} for way in (ones, others)]
    return fits_better(
        (ways[0][name](ids), ways[1][name](ids), pictured[name].read, pictured[name].size) for name, ids in read
    )


def _boxes(
    source: MaskSource, found: Mapping[str, Placement], pictured: Mapping[str, Pictured]
) -> dict[str, tuple[int, int, int, int]]:
    """Return the part of each mask that shows its picture, (x, y, width, height), for masks padded with borders."""
    ways: list[dict[str, tuple[int, int, int, int]]] = [{}, {}]
    for name, mask in source.masks.items():
        (width, height), (across, down) = mask.size, pictured[name].size
        size = (down, across) if found[name].turns % 2 else (across, down)
        scale = min(width / size[0], height / size[1])
        inner = round(size[0] * scale), round(size[1] * scale)
        over = width - inner[0], height - inner[1]
        is_networks = width % _NETWORK_STEP == 0 and height % _NETWORK_STEP == 0
        if max(over) >= 2 and (is_networks or not same_shape(mask.size, size)):
            ways[0][name] = (round(over[0] / 2 - 0.1), round(over[1] / 2 - 0.1), *inner)  # Ultralytics' rounding
            ways[1][name] = (0, 0, *inner)  # borders at the right and bottom only
    for way in ways:
        ids_of = {name: _ids(source, name) for name in evenly_spread([*way], _LOOKED_AT)}
        looked = [(way[name], ids) for name, ids in ids_of.items() if ids is not None and ids.any()]
        inside = (np.count_nonzero(ids[y : y + h, x : x + w]) == np.count_nonzero(ids) for (x, y, w, h), ids in looked)
        if looked and all(inside):
            return way
    return {}
