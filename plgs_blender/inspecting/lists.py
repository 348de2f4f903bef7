"""The lists of instances, their masks, and classes in a lift's collection, `collection.plgs`, saved in the .blend.

Rows are copies of the result's instances.json, so panels and overlays never read a file."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import bpy
import numpy as np
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    StringProperty,
)

from ...engine.corrections import CorrectedResult
from ...engine.posed import VOID, ClassTable
from ...engine.result_files import Instance, MatchedSegment
from ..lifecycle import register_modules, unregister_modules
from ..materials import UNKNOWN
from ..results import LiftResult
from . import looks
from .selection import choosing, renaming, select_row

WAYS_TO_SHOW = [
    (looks.POINTS, "Points", "The semantic points"),
    (looks.SPLATS, "Splats", "The Gaussians of the lifted model"),
    (looks.SURFACE, "Surface", "Meshes, one for each instance and each stuff class"),
]


Update = Callable[[bpy.types.PropertyGroup, bpy.types.Context], None]


def _applying(apply: Callable[[bpy.types.Collection], None]) -> Update:
    """Return a callback for a changed property, which calls ``apply`` with its lift's collection."""
    return lambda changed, _context: apply(changed.id_data)


def _update_colours(row: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    looks.apply_colours(row.id_data)
    if row.id_data.plgs.look in (looks.BY_CLASS, looks.INSTANCES):
        looks.apply_look(row.id_data)


def _update_name(row: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    for rename in renaming if row.name != row.known_name else ():
        rename(row.id_data, row.instance_id, row.name)


def _update_look(lists: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    looks.apply_look(lists.id_data)
    looks.apply_colours(lists.id_data)
    looks.show_pictures_in(context.scene)


def _update_show_as(lists: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    looks.apply_show_as(lists.id_data)
    looks.show_pictures_in(context.scene)


def _update_selection(lists: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    select_row(lists.id_data, context.view_layer)
    for follow in choosing:
        follow(lists.id_data)


def _update_catcher(lists: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    looks.apply_catcher(lists.id_data, context.scene)
    looks.show_pictures_in(context.scene)


# fmt: off
class PLGS_PG_mask(bpy.types.PropertyGroup):
    """A mask that was matched to an instance. `rectangle` and `outline`: see `MatchedSegment`."""

    frame: StringProperty(name="Frame")
    segment: IntProperty(name="Segment", description="Id of the segment in the frame's mask")
    class_id: IntProperty(name="Class id")
    class_name: StringProperty(name="Class", description="The class that the mask gives")
    score: FloatProperty(name="Score", description="The mask's confidence, 0 to 1")
    pixels: IntProperty(name="Pixels", description="Pixels with depth, at the size of the lift")
    share: FloatProperty(name="Share", description="Fraction of the picture's pixels")
    rectangle: FloatVectorProperty(name="Rectangle", size=4)
    outline: StringProperty(name="Outline")
    reason: StringProperty(name="Why", description="Why it was matched")


class PLGS_PG_instance(bpy.types.PropertyGroup):
    """An object of the lift. `known_name` is its name in the lift; a different `name` is a rename. `best_mask` and
    `mask_index` are rows of `masks`."""

    name: StringProperty(name="Name", update=_update_name, description="Double-click to rename the object")
    known_name: StringProperty()
    instance_id: IntProperty(name="Id")
    class_id: IntProperty(name="Class id")
    class_name: StringProperty(name="Class")
    colour: FloatVectorProperty(name="Colour", subtype="COLOR_GAMMA", size=3, min=0.0, max=1.0, update=_update_colours,
        description="Colour of its box, and of its points when it is selected")
    points: IntProperty(name="Points", description="Semantic points that belong to it")
    views: IntProperty(name="Views", description="Frames with a mask of it")
    score: FloatProperty(name="Score", description="Mean score of its masks, 0 to 1")
    visible: BoolProperty(name="Visible", default=True, update=_applying(looks.apply_visibility),
        description="Show its box, points and anchors")
    masks: CollectionProperty(type=PLGS_PG_mask)
    mask_index: IntProperty(name="Mask", default=-1)
    best_mask: IntProperty(name="Best mask", default=-1,
        description="The mask that shows most of it; -1 if masks are not known")


class PLGS_PG_class(bpy.types.PropertyGroup):
    """A class that has points. `class_id` 0 means no class."""

    name: StringProperty(name="Name")
    class_id: IntProperty(name="Id")
    colour: FloatVectorProperty(name="Colour", subtype="COLOR_GAMMA", size=3, min=0.0, max=1.0, update=_update_colours,
        description="Colour of its points, and of its boxes if they are coloured by class")
    points: IntProperty(name="Points")
    score: FloatProperty(name="Score", description="Mean confidence of its points, 0 to 1")
    is_thing: BoolProperty(name="Thing", description="Whether it has instances")
    visible: BoolProperty(name="Visible", default=True, update=_applying(looks.apply_visibility),
        description="Show its points, anchors and boxes")


class PLGS_PG_unshown(bpy.types.PropertyGroup):
    """An object that the masks show well from close up but the lift lacks."""

    name: StringProperty(name="What")
    frame: StringProperty(name="Frame", description="The frame that shows it best")


class PLGS_PG_lift(bpy.types.PropertyGroup):
    """The lists and settings of a lift, kept in its collection: `collection.plgs`."""

    instances: CollectionProperty(type=PLGS_PG_instance)
    instance_index: IntProperty(name="Instance", default=-1, update=_update_selection)
    classes: CollectionProperty(type=PLGS_PG_class)
    class_index: IntProperty(name="Class", default=-1)
    not_shown: CollectionProperty(type=PLGS_PG_unshown)
    instances_search: StringProperty(name="Search", options={"TEXTEDIT_UPDATE"},
        description="Show only instances whose names contain these words")
    classes_search: StringProperty(name="Search", options={"TEXTEDIT_UPDATE"},
        description="Show only classes whose names contain these words")
    isolated: IntProperty(name="Shown alone", default=0, update=_applying(looks.apply_visibility),
        description="Id of the only instance shown; 0: all are shown")
    look: EnumProperty(
        name="Colours",
        update=_update_look,
        description="What the colours in the view mean",
        items=[
            (looks.PHOTO, "Photo", "The photos' colours; boxes have the colours of their instances"),
            (looks.BY_CLASS, "Classes", "The classes' colours, also for boxes"),
            (looks.INSTANCES, "Instances", "Each instance in its own colour, everything else grey"),
            (looks.UNCERTAINTY, "Uncertainty", "Bright where the class is uncertain"),
        ],
    )
    show_as: EnumProperty(name="Show As", update=_update_show_as, description="How the lift is shown",
        items=WAYS_TO_SHOW)
    lit: BoolProperty(name="Lit", update=_applying(looks.apply_lit),
        description="Light the surface with the scene's lights instead of those in the photos")
    catch_shadows: BoolProperty(name="Catch Shadows", update=_update_catcher,
        description="Show only shadows and reflections of other objects on the surface, to render them over a photo or "
        "a baked frame. EEVEE uses the light that is strongest now")
    matte_follows: BoolProperty(name="Matte Follows Selection", update=_update_selection,
        description="The object that you choose in the view or the list is the matte in the compositor, too")
    show_cameras: BoolProperty(name="Cameras", update=_applying(looks.size_cameras),
        description="Draw the frames' cameras and their path")
    show_labels: BoolProperty(name="Labels", default=True, description="Draw the instances' names over the view")
    show_legend: BoolProperty(name="Legend", description="Draw the classes and their colours over the view")
    show_selected: BoolProperty(name="Outline Selected", default=True,
        description="Outline the selected instance, unless it is isolated")
    show_boxes: BoolProperty(name="All Boxes", update=_applying(looks.apply_visibility),
        description="Draw the boxes of all instances, not only of the selected ones")


# fmt: on
CLASSES = (PLGS_PG_mask, PLGS_PG_instance, PLGS_PG_class, PLGS_PG_unshown, PLGS_PG_lift)
PROPERTIES = ((bpy.types.Collection, "plgs", PLGS_PG_lift),)


@contextmanager
def registered() -> Iterator[None]:
    """Register `collection.plgs` for a ``with`` block, if the extension is off. Data written to it stays."""
    if hasattr(bpy.types.Collection, "plgs"):
        yield
        return
    register_modules([sys.modules[__name__]])
    try:
        yield
    finally:
        unregister_modules([sys.modules[__name__]])


def fill_lists(root: bpy.types.Collection, result: LiftResult | CorrectedResult, *, anew: bool = True) -> None:
    """List a result's classes and instances, whose masks are filled in later. With ``anew``, all instances become
    visible. Otherwise unchanged ones keep their rows and stay hidden, because listing thousands takes long."""
    with registered(), looks.apply_colours.at_once(root), looks.apply_visibility.at_once(root):
        lists = root.plgs
        root[looks.REMOVED] = json.dumps({one.id: one.name for one in result.removed})
        if anew:
            lists.instances.clear()
        lists.instance_index = lists.class_index = -1
        lists.isolated = 0
        _fill_instances(lists.instances, result.instances)
        lists.classes.clear()
        points = result.points
        ids, rows, counts = np.unique(points.class_id, return_inverse=True, return_counts=True)
        scores = np.bincount(rows, np.nan_to_num(points.confidence), len(ids)) / np.maximum(counts, 1)
        for class_id, count, score in zip(ids.tolist(), counts.tolist(), scores.tolist(), strict=True):
            known = result.classes[class_id] if class_id != VOID and class_id in result.classes else None
            row = lists.classes.add()
            row.class_id, row.points, row.score = class_id, count, score
            row.name = known.name if known else "unknown"
            row.is_thing = known is not None and known.is_thing
            row.colour = [channel / 255.0 for channel in (known.colour if known else UNKNOWN)]
        looks.size_cameras(root)
        looks.apply_show_as(root)
        if lists.look != looks.PHOTO:
            looks.apply_look(root)


def _fill_instances(rows: Any, instances: Sequence[Instance]) -> None:
    """Fill rows, which may hold other instances, with these instances, sorted by id."""
    wanted, before = {one.id for one in instances}, [row.instance_id for row in rows]
    if before != sorted({*before}):  # a file that another program changed
        rows.clear()
        before.clear()
    for index in [index for index, number in enumerate(before) if number not in wanted][::-1]:  # from the end
        rows.remove(index)
    known = {
        row.instance_id: _facts(row, row.score, [(mask.frame, mask.segment) for mask in row.masks]) for row in rows
    }
    for index, one in enumerate(instances):
        if one.id not in known:
            _fill_instance(rows.add(), one)
            rows.move(len(rows) - 1, index)
            continue
        score = float(np.float32(one.score))  # as Blender stores it
        if known[one.id] != _facts(one, score, [(mask.frame, mask.segment_id) for mask in one.segments]):
            rows[index].masks.clear()
            rows[index].mask_index = -1
            _fill_instance(rows[index], one)


def _facts(one: Any, score: float, masks: list[tuple[str, int]]) -> tuple[Any, ...]:
    """Return the facts by which an instance and its row in the list are compared; `one` is the instance or the row."""
    return one.name, one.class_id, one.points, one.views, score, masks


def fill_masks(root: bpy.types.Collection, instances: Iterable[Instance], classes: ClassTable) -> None:
    """Fill in the masks of instances that were listed without them."""
    with registered():
        rows = {row.instance_id: row for row in root.plgs.instances if not len(row.masks)}
        for instance in [each for each in instances if each.id in rows]:
            rows[instance.id].best_mask = best_view(instance.segments)
            for mask in instance.segments:
                each = rows[instance.id].masks.add()
                each.frame, each.segment, each.class_id = mask.frame, mask.segment_id, mask.class_id
                each.class_name = classes[mask.class_id].name if mask.class_id in classes else "unknown"
                each.score, each.pixels, each.share = mask.score, mask.pixels, mask.share
                each.rectangle, each.outline, each.reason = mask.rectangle, mask.outline, _reason(mask)


def fill_not_shown(root: bpy.types.Collection, result: LiftResult) -> None:
    """List in the lift's collection the objects that the masks show and the lift lacks."""
    with registered():
        root.plgs.not_shown.clear()
        for text, frame in result.not_shown:
            row = root.plgs.not_shown.add()
            row.name, row.frame = text, frame


def best_view(masks: Sequence[MatchedSegment]) -> int:
    """The index of the mask that covers most of its picture (half counts if the edge cuts it off); -1 if unknown."""
    is_cut_off = [min(mask.rectangle) <= 0.0 or max(mask.rectangle) >= 1.0 for mask in masks]
    worth = [mask.share * (0.5 if cut_off else 1.0) for mask, cut_off in zip(masks, is_cut_off, strict=True)]
    return int(np.argmax(worth)) if worth and max(worth) > 0.0 else -1


def _reason(mask: MatchedSegment) -> str:
    """Return why a mask was matched to its instance, such as "84 % agreement", for a list."""
    if mask.agreement is not None:
        return f"{100 * mask.agreement:.0f} % agreement"
    if mask.cost is not None:
        return f"cost {mask.cost:.2f}"
    return "first mask" if mask.share > 0.0 else ""


def _fill_instance(row: Any, instance: Instance) -> None:
    row.instance_id = instance.id
    row.known_name = row.name = instance.name
    row.class_id, row.class_name = instance.class_id, instance.class_name
    row.colour = [channel / 255.0 for channel in instance.colour]
    row.points, row.views, row.score = instance.points, instance.views, instance.score
