"""Ground truth for the metrics: never read by the lift itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..posed.classes import VOID, ClassTable
from ..posed.image_header import check_image_file
from ..posed.layout import files_by_stem, natural_order, same_shape, shown_size
from .class_choice import ClassChoice, find_class_choice
from .class_map import class_map
from .class_tables import REDUCED, TABLES, known_table, reduced_by_name
from .frame import GroundTruth, Size
from .label_image import check_label_header
from .mask_formats.source import IGNORED
from .pixels import decode_single_channel, distinct_ids, resize_nearest

_ANYTHING = 21
"""The last of the paper's classes: all other things."""
_FIX = "Correct it, or remove the ground truth: only the metrics need it."


@dataclass(frozen=True)
class GroundTruthReader:
    """Reads one frame's ground truth. ``class_of`` maps its class ids to the masks', void where they have none of the
    same name; ids that it does not have become void, too. ``names`` are those of its own table, if it has one."""

    semantic: Path
    instance: Path
    class_of: Mapping[int, int]
    names: Mapping[int, str]

    def __call__(self, size: Size | None = None) -> GroundTruth:
        """Ground truth at ``size`` (width, height) or its own. Raises PlgsError when a file is bad."""
        stored = read_label_pair(self.semantic, self.instance)
        semantic, instance = in_classes(stored.semantic, self.class_of), stored.instance
        if size is not None:
            semantic, instance = resize_nearest(semantic, size), resize_nearest(instance, size)
        return GroundTruth(semantic, instance)

    def unknown(self) -> frozenset[int | str]:
        """Classes in the file, void aside, that the masks' table does not have: names, or ids without one. Raises
        PlgsError for a bad file."""
        check_image_file(self.instance)
        found, _ = distinct_ids(decode_single_channel(self.semantic))
        lacking = frozenset(found.tolist()) - frozenset(self.class_of) - (IGNORED if self.names else {VOID})
        return frozenset(self.names.get(number, number) for number in lacking)


def read_label_pair(semantic: Path, instance: Path) -> GroundTruth:
    """Class ids and instance ids out of two label images. Raises PlgsError when a file is bad."""
    stored = GroundTruth(decode_single_channel(semantic), decode_single_channel(instance))
    if stored.semantic.shape != stored.instance.shape:
        raise PlgsError("classes and instances differ in size", instance, "Make both the same size.")
    return stored


def open_ground_truth(
    scene: Path, sizes: Mapping[str, Size], classes: ClassTable
) -> tuple[dict[str, GroundTruthReader], list[str]]:
    """Ground truth in ``rs_semantics`` and ``rs_instance``, or ``gt/semantic*`` and ``gt/instance``; headers only.

    The result has a reader for each frame with ground truth, and warnings. ``sizes`` are those of the colour images by
    frame. Class ids are those of the masks' table ``classes``; where the ground truth has a table of its own (see
    ``_own_table``), its classes become those of the same name. Raises PlgsError when an image is not a label image or
    has another shape.
    """
    folders = _find_folders(scene)
    if folders is None:
        return {}, []
    semantics = files_by_stem(folders[0], {".png"}, _FIX)
    instances = files_by_stem(folders[1], {".png"}, _FIX)
    readers: dict[str, GroundTruthReader] = {}
    names = _own_table(folders[0])
    class_of = {number: number for number in classes.ids} if names is None else classes_by_name(names, classes)
    for name, size in sizes.items():
        if name in semantics and name in instances:
            readers[name] = GroundTruthReader(semantics[name], instances[name], class_of, names or {})
            for path in (semantics[name], instances[name]):
                own = check_label_header(path)
                if not same_shape(own, size):
                    what = f"ground truth of {shown_size(own)} does not fit the colour of {shown_size(size)}"
                    raise PlgsError(what, path, _FIX)
    if len(readers) < len(sizes):
        return readers, [
            f"{len(sizes) - len(readers)} of {len(sizes)} frames have no ground truth in {folders[0].name}"
        ]
    return readers, []


def _own_table(folder: Path) -> dict[int, str] | None:
    """The names of the ground truth's classes by number: those of ``classes.toml`` beside its folder, or of the table
    that the folder's name ends with, such as ``semantic_nyu40``; in ``rs_semantics`` the paper's 21. None: as the
    masks. Raises PlgsError."""
    choice = find_class_choice(None, folder.parent) if folder.parent.name == "gt" else None
    table = REDUCED if folder.name == "rs_semantics" else folder.name.removeprefix("semantics").removeprefix("semantic")
    if choice is None and table.strip("_-") in TABLES:
        choice = ClassChoice(table=table.strip("_-"))
    if choice is None:
        return None
    own = class_map(None, choice, folder, objects=False)
    return {n: "void" if class_id == VOID else own.classes[class_id].name for n, class_id in own.class_of.items()}


def in_classes(semantic: NDArray[np.integer], class_of: Mapping[int, int]) -> NDArray[np.int32]:
    """Class ids [H, W] from 0 on, each as ``class_of`` maps it, and void where that lacks it."""
    known = np.zeros(int(semantic.max(initial=0)) + 1, np.int32)
    for number, class_id in class_of.items():
        if number < len(known):
            known[number] = class_id
    return known[semantic]


def classes_by_name(names: Mapping[int, str], classes: ClassTable) -> dict[int, int]:
    """The class in ``classes`` for each number of another table with ``names``; numbers without any are left out.

    Names match if they differ only in case and in endings such as COCO's "-merged". Else the paper's 21 classes decide:
    a class matches if it is the only one in ``classes`` with the same of the 21.
    """
    by_name = {_plain(each.name): each.id for each in reversed(classes.categories)} | {"void": VOID}
    by_reduced: dict[int | None, list[int]] = {}
    for each in classes.categories:
        by_reduced.setdefault(reduced_by_name(each.name), []).append(each.id)
    is_reduced = {each.name for each in classes.categories} == {label.name for label in known_table(REDUCED).labels}
    found = {}
    for number, name in names.items():
        words = [_plain(name), *map(_plain, name.split(","))]
        same = [by_name[word] for word in words if word in by_name]
        reduced = reduced_by_name(name)
        if not same and reduced is not None and reduced != VOID and (is_reduced or reduced != _ANYTHING):
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


def _find_folders(scene: Path) -> tuple[Path, Path] | None:
    """The folders of classes and of instances; None when either is missing."""
    if (scene / "rs_semantics").is_dir() and (scene / "rs_instance").is_dir():
        return scene / "rs_semantics", scene / "rs_instance"
    found = [path for path in (scene / "gt").glob("semantic*") if path.is_dir()]
    if found and (scene / "gt" / "instance").is_dir():
        return min(found, key=lambda path: natural_order(path.name)), scene / "gt" / "instance"
    return None
