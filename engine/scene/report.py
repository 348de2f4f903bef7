"""Summarise a scene and the classes of its masks, for ``python -m engine inspect``, ``classes`` and the panel."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PlgsError
from ..job.atomic import write_atomically
from ..job.own_files import OwnFiles
from ..job.progress import unwatched
from ..json_file import read_object
from ..posed.classes import VOID
from ..records import record_of
from ..scene_source import SceneSource
from .checks import Survey
from .class_choice import FILE_NAME, class_choice_text, find_class_choice
from .class_map import NamedClass, choice_of, named_classes
from .frame import Inferred, LeftOut, Size, doubts
from .masks import mask_place, no_masks, open_mask_source
from .numbering import numbered
from .opening import open_asked


@dataclass(frozen=True)
class ClassReport:
    """A class of the masks: ``colour`` in sRGB bytes, and ``share`` of all mask pixels (0..1)."""

    id: int
    name: str
    is_thing: bool
    colour: tuple[int, int, int]
    share: float


@dataclass(frozen=True)
class SceneReport:
    """Counts and ranges over all frames that a lift would use. ``format`` is the name of the scene's reader.
    ``sparse_points`` counts the points of the reconstruction behind the poses, ``picture_files`` the frames whose
    picture is an unmodified image file. Sizes are (width, height) with their number of frames, the commonest first.
    ``depth_range`` is the nearest, median and farthest depth in metres, ``segments_per_frame`` the fewest, the median
    and the most; None without depth or masks. ``void_share`` is the fraction of mask pixels without a label.
    ``classes`` are those that occur. ``extent`` is the box around the cameras' centres, in metres along x, y, z.
    ``warnings`` are further ones than ``left_out`` and ``inferred``."""

    folder: Path
    format: str
    train_frames: int
    test_frames: int
    ground_truth_frames: int
    colour_sizes: tuple[tuple[Size, int], ...]
    depth_sizes: tuple[tuple[Size, int], ...]
    mask_sizes: tuple[tuple[Size, int], ...]
    depth_range: tuple[float, float, float] | None
    segments_per_frame: tuple[int, int, int] | None
    classes: tuple[ClassReport, ...]
    void_share: float
    extent: tuple[float, float, float]
    sparse_points: int
    picture_files: int
    left_out: tuple[LeftOut, ...]
    inferred: tuple[Inferred, ...]
    warnings: tuple[str, ...]


def report_of(survey: Survey) -> SceneReport:
    """Summarise a survey of a scene."""
    scene = survey.scene
    depths = [fact.depth for fact in survey.frames if fact.depth is not None]
    masks = [fact.mask for fact in survey.frames if fact.mask is not None]
    shares: dict[int, float] = dict.fromkeys((VOID, *scene.classes.ids), 0.0)
    for mask in masks:
        for class_id, share in mask.class_pixels:
            shares[class_id] += share / len(masks)
    nearest, middle, farthest = ([depth.range[place] for depth in depths] for place in range(3))
    segments = sorted(mask.segments for mask in masks)
    centres = np.array([frame.camera.centre for frame in scene.frames])
    extent = np.ptp(centres, axis=0)
    return SceneReport(
        folder=scene.folder,
        format=scene.format,
        train_frames=len(scene.train_frames),
        test_frames=len(scene.test_frames),
        ground_truth_frames=sum(frame.read_ground_truth is not None for frame in scene.frames),
        colour_sizes=tuple(Counter(frame.size for frame in scene.frames).most_common()),
        depth_sizes=tuple(Counter(depth.size for depth in depths).most_common()),
        mask_sizes=tuple(Counter(mask.size for mask in masks).most_common()),
        depth_range=(min(nearest), float(np.median(middle)), max(farthest)) if depths else None,
        segments_per_frame=(segments[0], segments[len(segments) // 2], segments[-1]) if segments else None,
        classes=tuple(
            ClassReport(category.id, category.name, category.is_thing, category.colour, shares[category.id])
            for category in scene.classes.categories
            if shares[category.id] > 0.0
        ),
        void_share=shares[VOID],
        extent=(float(extent[0]), float(extent[1]), float(extent[2])),
        sparse_points=0 if scene.points is None else len(scene.points),
        picture_files=sum(frame.file_shows_colour for frame in scene.frames),
        left_out=scene.left_out,
        inferred=scene.inferred,
        warnings=tuple(each for each in scene.warnings + survey.warnings if each not in doubts(scene.inferred)),
    )


_AGAIN = "Read the classes again."


@dataclass(frozen=True)
class ClassList:
    """The classes of a scene's masks as an editable list: ``rows`` by the masks' numbers, the numbers that mean
    ``void``, and the ``path`` of classes.toml, which may not exist yet."""

    path: Path
    rows: tuple[NamedClass, ...]
    void: tuple[int, ...] = ()


def list_classes(source: SceneSource, table: str | None = None) -> ClassList:
    """The classes in the masks' files and in a classes.toml beside them. With ``table`` (see ``TABLES``), the list
    starts over with that table's classes, for masks whose files name none. The scene is opened. Raises PlgsError for
    masks without classes."""
    path = class_list_path(source.scene, source.masks)
    scene = open_asked(replace(source, up="z", classes=table))
    place, names = _place_of_masks(source.scene, source.masks), [frame.name for frame in scene.frames]
    masks = open_mask_source(place, names, source.mask_format, unwatched)
    if table is not None and masks.tells_no_class:
        fix = f"Write {FILE_NAME} beside them: [[class]] with id, name and thing for each number."
        raise PlgsError("masks-classless", "the masks number objects and have no classes, so no table fits", place, fix)
    masks, choice, _ = numbered(masks, find_class_choice(table, path.parent), place)
    if table is not None and choice is not None:
        return ClassList(path, tuple(named_classes(choice.labels or (), None)))
    labels = masks.labels or ()
    void = () if choice is None else tuple(sorted(choice.void))
    has_any = labels or (choice is not None and (choice.rows or choice.labels))
    return ClassList(path, tuple(named_classes(labels, choice)) if has_any else (), void)


def write_class_list(source: SceneSource, edited: Path) -> Path:
    """Write the classes.toml beside a scene's masks from an edited ClassList, which is in a JSON file, and return its
    path. The colours of an existing classes.toml are kept; one that PLGS did not write is renamed to
    "classes.before.toml". Raises PlgsError for a list of another scene, and for a class without a name."""
    content: dict[str, Any] = read_object(edited, _AGAIN)
    listed, path = record_of(ClassList, content, edited, _AGAIN), class_list_path(source.scene, source.masks)
    if not listed.rows:
        raise PlgsError("no-classes", "there are no classes to write", "Classes", "Read them from the masks first.")
    if not all(row.name.isprintable() and row.name and row.into.isprintable() for row in listed.rows):
        raise PlgsError("class-unnamed", "a class has no name", "Classes", "Give each class a name of one line.")
    if listed.path.absolute() != path.absolute():
        raise PlgsError("other-scene", "the list belongs to another scene", path, _AGAIN)
    rows = [replace(row, into=row.into or row.name) for row in listed.rows]
    choice, before = choice_of(rows, frozenset(listed.void)), find_class_choice(None, path.parent)
    colours = {each: row.colour for row in (before.rows if before else ()) for each in (row.id, row.name)}
    kept = tuple(replace(row, colour=colours.get(row.id) or colours.get(row.name)) for row in choice.rows)
    with OwnFiles(path.parent).begin("classes", {}, among_others=True) as own:
        own.set_aside(path)
        write_atomically(path, class_choice_text(replace(choice, rows=kept)))
    own.complete()
    return path


def class_list_path(folder: Path, masks: Path | None = None) -> Path:
    """The path of the classes.toml beside a scene's masks; it may not exist yet. Raises PlgsError without masks."""
    place = _place_of_masks(folder, masks)
    beside = place if place.is_dir() else place.parent
    path = beside / FILE_NAME
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise PlgsError("not-a-file", "this is a link or a folder, not a file", path, "Move it away.")
    find_class_choice(None, beside)
    return path


def _place_of_masks(folder: Path, masks: Path | None) -> Path:
    place = mask_place(folder if folder.is_dir() else folder.with_suffix(""), masks)
    if place is None:
        raise no_masks(folder)
    return place
