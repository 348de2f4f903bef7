"""Read folders of label images by any program: classes and instances of each frame, for comparison with others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np

from ..errors import PlgsError
from ..json_file import read_json_object
from ..posed.classes import VOID, ClassTable
from ..posed.layout import files_by_stem, require_all
from .class_map import class_map, coloured
from .class_tables import REDUCED, known_table
from .frame import GroundTruth, PanopticMask, mapped
from .frame_choice import evenly_spread
from .ground_truth import LOOKED_AT, classes_by_name, joined, read_label_pair, refuse_other_numbers
from .mask_formats import label_pairs
from .mask_formats.coco import read_categories
from .masks import open_masks
from .pixels import check_label_header, resize_nearest

PAIRS = (
    ("gt/semantic", "gt/instance"),
    ("rs_semantics", "rs_instance"),
    ("m2f_semantics", "m2f_instance"),
    *label_pairs.PAIRS,
)
"""Folders of classes and of instances, in the order in which they are tried."""
_FIX = (
    "Give a folder with panoptic.json and panoptic/ (COCO), or with PNGs of class ids and of instance ids in "
    f"{', '.join(' and '.join(pair) for pair in PAIRS)}."
)
_TABLE_FIX = 'Put COCO\'s panoptic.json, or a labels.json with "classes", into the folder of predictions or of truth.'


@dataclass(frozen=True, eq=False)
class LabelFolder:
    """A folder of label images: its ``classes``, if known, and ``readers`` by frame, of labels at their own size."""

    folder: Path
    classes: ClassTable | None
    readers: Mapping[str, Callable[[], GroundTruth]]


def _as_labels(read: Callable[[], PanopticMask]) -> GroundTruth:
    """Return the classes and instances of a mask: a thing's instance is its segment, stuff has none."""
    mask = read()
    things = [segment.id for segment in mask.segments if segment.is_thing]
    return GroundTruth(mask.class_map(), np.where(np.isin(mask.ids, things), mask.ids, 0).astype(np.int32))


def open_label_folder(folder: Path, *, is_truth: bool) -> LabelFolder:
    """Open the labels in a folder; only headers are read. If it is a scene's folder with both predictions and ground
    truth, ``is_truth`` chooses. Raises PlgsError if there are none, or a file is bad."""
    if not folder.is_dir():
        raise PlgsError("not-folder", "is not a folder", folder, _FIX)
    table = folder / "panoptic.json"
    pairs = [(folder / one, folder / other) for one, other in PAIRS if (folder / one).is_dir()]
    if table.is_file() and not (is_truth and pairs):
        return _coco(folder)
    if not pairs:
        raise PlgsError("no-labels", "there are no labels here", folder, _FIX)
    semantics, instances = (files_by_stem(each, {".png"}, _FIX) for each in pairs[0])
    require_all(list(semantics), instances, "instance image", pairs[0][1], "Give it the name of the class image.")
    for path in (*semantics.values(), *(instances[name] for name in semantics)):
        check_label_header(path)
    readers = {name: partial(read_label_pair, path, instances[name]) for name, path in semantics.items()}
    return LabelFolder(folder, _classes(folder, pairs[0][0]), readers)


def _coco(folder: Path) -> LabelFolder:
    names = list(files_by_stem(folder / "panoptic", {".png"}, _FIX))
    masks = open_masks(folder, names, mask_format="coco")
    require_all(names, masks.readers, "readable mask", folder / "panoptic.json", _FIX)
    readers = {name: partial(_as_labels, read) for name, read in masks.readers.items()}
    return LabelFolder(folder, masks.classes, readers)


def _classes(folder: Path, semantics: Path) -> ClassTable | None:
    if (folder / "panoptic.json").is_file():
        return open_masks(folder, [], mask_format="coco").classes
    path = folder / "labels.json"  # of export --to instances
    if path.is_file():
        labels = read_categories(read_json_object(path), path, "classes", "is_thing")
        if any(label.id == VOID for label in labels):
            raise PlgsError("class-id", "a class has the id 0", path, "Give each class an id of its own, from 1.")
        return coloured(labels)
    if semantics.name not in ("rs_semantics", "m2f_semantics"):
        return None
    return class_map(known_table(REDUCED).labels, None, folder, False).classes


def in_one_table(predictions: LabelFolder, truth: LabelFolder) -> tuple[ClassTable, LabelFolder]:
    """One class table for predictions and ground truth, in which ids mean the same, and the predictions in it. If an id
    has two names, the ground truth's counts: predicted classes become the true ones of the same name; classes without
    one are appended. Raises PlgsError without a table, without a common class name, or if numbers look like another
    table."""
    tables = [each.classes for each in (predictions, truth) if each.classes is not None]
    if not tables:
        raise PlgsError("no-table", "no class table says which classes are things", truth.folder, _TABLE_FIX)
    if len(tables) == 1:
        _refuse_other_numbers(*((truth, predictions) if truth.classes is None else (predictions, truth)), tables[0])
    own, true = tables[0], tables[-1]
    if not any(each.id in own and (own[each.id].name, own[each.id].is_thing) != (each.name, each.is_thing)
               for each in true.categories):  # fmt: skip
        merged = {each.id: each for table in tables for each in table.categories}
        return ClassTable(tuple(merged[class_id] for class_id in sorted(merged))), predictions
    class_of = classes_by_name({each.id: each.name for each in own.categories}, true)
    if not class_of:
        what = f"no class name of {predictions.folder} is in the ground truth"
        raise PlgsError("other-classes", what, truth.folder, "Use one class table for both.")
    free = count(max(true.ids) + 1)
    others = tuple(replace(each, id=next(free)) for each in own.categories if each.id not in class_of)
    left = [each.id for each in own.categories if each.id not in class_of]
    class_of |= dict(zip(left, (each.id for each in others), strict=True))

    def in_its_classes(read: Callable[[], GroundTruth]) -> GroundTruth:
        stored = read()
        return GroundTruth(mapped(stored.semantic, class_of, np.zeros(1, np.int32)), stored.instance)

    readers = {name: partial(in_its_classes, read) for name, read in predictions.readers.items()}
    return ClassTable((*true.categories, *others)), replace(predictions, readers=readers)


def _refuse_other_numbers(folder: LabelFolder, known: LabelFolder, classes: ClassTable) -> None:
    """Raise PlgsError if the numbers of a folder without a table look like a table other than ``classes``."""
    joint = Counter[tuple[int, int]]()
    for name in evenly_spread([name for name in known.readers if name in folder.readers], LOOKED_AT):
        numbers = folder.readers[name]().semantic
        size = (numbers.shape[1], numbers.shape[0])
        joint.update(joined(numbers, resize_nearest(known.readers[name]().semantic, size)))
    refuse_other_numbers(joint, classes, folder.folder, _TABLE_FIX)
