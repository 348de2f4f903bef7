"""Ground truth, which only the metrics read, and what its numbers mean: classes of the table that its folder or a file
names, else the masks' class ids. Numbers that look like another table are refused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..posed.classes import VOID, ClassTable
from ..posed.image_header import check_image_file
from ..posed.layout import files_by_stem, listed, natural_order, same_shape, shown_files, shown_size
from .class_choice import FILE_NAME, ClassChoice, find_class_choice
from .class_map import class_map
from .class_tables import ANYTHING, NUMBERINGS, REDUCED, TABLES, known_table, numberings_of, reduced_by_name
from .frame import GroundTruth, Inferred, Size, mapped
from .frame_choice import evenly_spread
from .mask_formats.label_pairs import label_pairs
from .mask_formats.source import IGNORED, MaskSource
from .masks import MaskSet
from .numbering import Asking, numbered
from .pixels import check_label_header, distinct_ids, read_indices, resize_nearest

LOOKED_AT = 6  # frames in which ground truth is compared with the masks
_FEWEST = 500  # minimum number of pixels for a meaningful agreement
_POOR, _ENOUGH = 0.1, 0.2  # fractions of agreeing pixels: hardly any, and enough to suspect a table
_REFUTED, _EQUAL = 0.6, 0.95
"""Agreement relative to the best table's. Below the first, the numbers are not the masks' class ids; tables above the
second are as likely as the best."""
_ASKING = Asking("the ground truth's", 'table = "{}"', f"write {{}} into {FILE_NAME} beside its folder", "")
_NAME_IT = f"name its table in {FILE_NAME} beside its folder"

Joint = Mapping[tuple[int, int], int]
"""The number of pixels for each pair of a ground-truth number and a class of the masks. Possible void is left out: a
table whose 0 is a wall is recognised by its other numbers."""


@dataclass(frozen=True)
class Numbers:
    """What ground truth's numbers mean: ``class_of`` maps them to the masks' classes, ``names`` to their own names."""

    class_of: Mapping[int, int]
    names: Mapping[int, str] = field(default_factory=dict)
    inferred: tuple[Inferred, ...] = ()


def numbers_of_truth(folder: Path, files: Mapping[str, Path], masks: MaskSet) -> Numbers:
    """Find out what the numbers in a ``folder`` of ground truth mean; its ``files`` are by frame. Its table is named by
    ``classes.toml`` beside it, or by the folder (``semantic_nyu40``; ``rs_semantics``: the paper's 21). Raises
    PlgsError if the numbers look like another table's."""
    choice = _own_choice(folder)
    if choice is None:
        doubts = refuse_other_numbers(_compared(files, masks), masks.classes, folder)
        return Numbers({number: number for number in masks.classes.ids}, inferred=doubts)
    source = MaskSource(label_pairs(files, {}), void=IGNORED)
    _, choice, inferred = numbered(source, choice, folder, _ASKING)
    names = _names(choice, folder)
    return Numbers(classes_by_name(names, masks.classes), names, inferred=inferred)


def _own_choice(folder: Path) -> ClassChoice | None:
    choice = find_class_choice(None, folder.parent) if folder.parent.name == "gt" else None
    table = REDUCED if folder.name == "rs_semantics" else folder.name.removeprefix("semantics").removeprefix("semantic")
    if choice is None and table.strip("_-") in TABLES:
        choice = ClassChoice(table=table.strip("_-"))
    return choice


def _names(choice: ClassChoice | None, where: Path) -> dict[int, str]:
    own = class_map(None, choice, where, objects=False)
    return {n: "void" if class_id == VOID else own.classes[class_id].name for n, class_id in own.class_of.items()}


def _compared(files: Mapping[str, Path], masks: MaskSet) -> Joint:
    """Return the pixels of each pair (ground truth's number, class) in some frames. Unreadable files are skipped."""
    joint = Counter[tuple[int, int]]()
    for name in evenly_spread([name for name in masks.readers if name in files], LOOKED_AT):
        try:
            numbers = read_indices(files[name])
            classes = masks.readers[name]((numbers.shape[1], numbers.shape[0])).class_map()
        except PlgsError:  # the later reader reports the error
            continue
        joint.update(joined(numbers, classes))
    return joint


def joined(numbers: NDArray[np.integer], classes: NDArray[np.integer]) -> Counter[tuple[int, int]]:
    """Count the pixels of each pair (ground truth's number, class) of two maps [H, W], where neither is void."""
    pairs = numbers.astype(np.int64) << 32 | classes  # one number per pair: np.unique is slow on rows
    known = pairs[(classes != VOID) & ~np.isin(numbers, [*IGNORED])]
    values, counts = (found.tolist() for found in np.unique(known, return_counts=True))
    return Counter({(pair >> 32, pair & 0xFFFFFFFF): count for pair, count in zip(values, counts, strict=True)})


def refuse_other_numbers(joint: Joint, classes: ClassTable, where: Path, fix: str = "") -> tuple[Inferred, ...]:
    """Raise PlgsError if the numbers counted in ``joint`` agree with the masks far better as those of another table
    than as ids of ``classes``: a table must not be chosen because it scores best. Returns a doubt if numbers and masks
    hardly agree at all. ``fix`` tells how to name a table, if that is not done in a file beside the ground truth."""
    total, numbers = sum(joint.values()), {number for number, _ in joint}
    own = sum(pixels for (number, class_id), pixels in joint.items() if number == class_id)
    if total < _FEWEST or len(numbers) < 2 or len({class_id for _, class_id in joint}) < 2:
        return ()
    if own >= max(_REFUTED, _POOR) * total:  # no table could do much better
        return ()
    found = {}
    for table in (*NUMBERINGS, *(each for each in TABLES if each == numberings_of(each)[0])):
        names = _names(ClassChoice(table=table), where)
        if numbers <= names.keys():
            class_of = classes_by_name(names, classes)
            found[table] = sum(n for (number, class_id), n in joint.items() if class_of.get(number) == class_id)
    best = max(found.values(), default=0)
    if best >= _ENOUGH * total and own < _REFUTED * best:
        likely = [table for table, pixels in found.items() if pixels >= _EQUAL * best]
        shares = f"{best / total:.0%} of the pixels then agree with the masks, {own / total:.0%} as class ids"
        what = f"the ground truth's numbers look like {listed(likely, 3)}, not like class ids of the masks ({shares})"
        named = f"{_ASKING.advice(*likely[:3]).capitalize()}."
        raise PlgsError("truth-numbers", what, where, fix or named)
    if own >= _POOR * total:
        return ()
    reason = f"{own / total:.0%} of the pixels agree with the masks then; if that is wrong, {_NAME_IT}"
    return (Inferred("numbering", "the ground truth's numbers are read as class ids of the masks", reason),)


def classes_by_name(names: Mapping[int, str], classes: ClassTable) -> dict[int, int]:
    """Return the class in ``classes`` for each number of another table with ``names``; numbers without a match are left
    out. Names match if they are equal, or else differ only in case and in endings such as COCO's "-merged". Otherwise
    the match is the only class in ``classes`` that belongs to the same one of the paper's 21."""
    by_name = {spell(each.name): each.id for spell in (_plain, str) for each in reversed(classes.categories)}
    by_name["void"] = VOID
    by_reduced: dict[int | None, list[int]] = {}
    for each in classes.categories:
        by_reduced.setdefault(reduced_by_name(each.name), []).append(each.id)
    is_reduced = {each.name for each in classes.categories} == {label.name for label in known_table(REDUCED).labels}
    found = {}
    for number, name in names.items():
        words = [name, _plain(name), *map(_plain, name.split(","))]
        same = [by_name[word] for word in words if word in by_name]
        reduced = reduced_by_name(name, with_raw=True)
        if not same and reduced is not None and reduced != VOID and (is_reduced or reduced != ANYTHING):
            same = by_reduced.get(reduced, [])
            same = same if len(same) == 1 else []
        if same:
            found[number] = same[0]
    return found


def _plain(name: str) -> str:
    name = name.casefold().strip().replace("_", " ")
    for ending in ("-merged", "-stuff"):
        name = name.removesuffix(ending)
    return name


_FIX = "Correct it, or remove the ground truth: only the metrics need it."


@dataclass(frozen=True)
class GroundTruthReader:
    """Reads one frame's ground truth from two label images. ``class_of`` maps the truth's class ids to the masks'; ids
    that ``class_of`` lacks become void. ``names`` are those of the truth's own table, if it has one."""

    semantic: Path
    instance: Path
    class_of: Mapping[int, int]
    names: Mapping[int, str]

    def __call__(self, size: Size | None = None) -> GroundTruth:
        """Read ground truth at ``size`` (width, height) or its own. Raises PlgsError for a bad file."""
        stored = read_label_pair(self.semantic, self.instance)
        semantic, instance = mapped(stored.semantic, self.class_of, np.zeros(1, np.int32)), stored.instance
        if size is not None:
            semantic, instance = resize_nearest(semantic, size), resize_nearest(instance, size)
        return GroundTruth(semantic, instance)

    def unknown(self) -> frozenset[int | str]:
        """Return the classes in the file that the masks lack, by name or id. Raises PlgsError for a bad file."""
        check_image_file(self.instance)
        found, _ = distinct_ids(read_indices(self.semantic))
        lacking = frozenset(found.tolist()) - frozenset(self.class_of) - (IGNORED if self.names else {VOID})
        return frozenset(self.names.get(number, number) for number in lacking)


def read_label_pair(semantic: Path, instance: Path) -> GroundTruth:
    """Read class ids and instance ids from two label images. Raises PlgsError for a bad file, or different sizes."""
    stored = GroundTruth(read_indices(semantic), read_indices(instance))
    if stored.semantic.shape != stored.instance.shape:
        raise PlgsError("other-size", "classes and instances differ in size", instance, "Make both the same size.")
    return stored


def open_ground_truth(
    scene: Path, sizes: Mapping[str, Size], masks: MaskSet
) -> tuple[dict[str, GroundTruthReader], tuple[str, ...], tuple[Inferred, ...]]:
    """Open the ground truth in ``rs_semantics`` and ``rs_instance``, or ``gt/semantic*`` and ``gt/instance``. Returns a
    reader for each frame that has it, in the classes of the ``masks``; warnings; and what was inferred. ``sizes`` are
    those of the colour images by frame. Raises PlgsError if an image is not a label image or has another shape."""
    folders = _find_folders(scene) if masks.readers else None
    if folders is None:
        return {}, (), ()
    semantics = files_by_stem(folders[0], {".png"}, _FIX)
    instances = files_by_stem(folders[1], {".png"}, _FIX)
    pairs = {name: (semantics[name], instances[name]) for name in sizes if name in semantics and name in instances}
    for name, paths in pairs.items():
        for path in paths:
            own = check_label_header(path)
            if not same_shape(own, sizes[name]):
                what = f"ground truth of {shown_size(own)} does not fit the colour image of {shown_size(sizes[name])}"
                raise PlgsError("truth-shape", what, path, _FIX)
    numbers = numbers_of_truth(folders[0], {name: semantic for name, (semantic, _) in pairs.items()}, masks)
    readers = {name: GroundTruthReader(*paths, numbers.class_of, numbers.names) for name, paths in pairs.items()}
    lacking = f"{len(sizes) - len(readers)} of {len(sizes)} frames have no ground truth in {folders[0].name}"
    return readers, (lacking,) if len(readers) < len(sizes) else (), numbers.inferred


def _find_folders(scene: Path) -> tuple[Path, Path] | None:
    if (scene / "rs_semantics").is_dir() and (scene / "rs_instance").is_dir():
        return scene / "rs_semantics", scene / "rs_instance"
    found = [path for path in shown_files(scene / "gt", "semantic*") if path.is_dir()]
    if found and (scene / "gt" / "instance").is_dir():
        return min(found, key=lambda path: natural_order(path.name)), scene / "gt" / "instance"
    return None
