"""What a lift's collection knows of its instances and classes: `collection.plgs`, kept in the .blend, undone with it.

Rows are plain copies of the result's instances.json, so that panels and overlays never read a file.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from .colouring import apply_colours
from .labels import let_boxes_show_names
from .selection import select_row
from .visibility import apply_visibility

NO_COST, NO_AGREEMENT = 1.0, -1.0
"""Values of a mask's `cost` and `agreement` that say there is none."""


def _show(row: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    apply_visibility(row.id_data)


def _colour(row: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    apply_colours(row.id_data)


def _choose(lists: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    select_row(lists.id_data, context.view_layer)


def _name_boxes(lists: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    let_boxes_show_names(lists.id_data, not lists.show_labels)


class PLGS_PG_mask(bpy.types.PropertyGroup):
    """One mask that was matched to an instance. `rectangle`: left, top, right, bottom in shares of the picture."""

    frame: StringProperty(name="Frame")  # type: ignore[valid-type]
    segment: IntProperty(name="Segment", description="Id of the segment in the frame's mask")  # type: ignore[valid-type]
    class_id: IntProperty(name="Class id")  # type: ignore[valid-type]
    class_name: StringProperty(name="Class", description="What this mask took it for")  # type: ignore[valid-type]
    score: FloatProperty(name="Score", description="How sure the mask was, 0 to 1")  # type: ignore[valid-type]
    cost: FloatProperty(  # type: ignore[valid-type]
        name="Cost", default=NO_COST,
        description="Cost of the match by boxes, -1.5 (the same box) to 0; 1 when it was not matched by boxes",
    )  # fmt: skip
    agreement: FloatProperty(  # type: ignore[valid-type]
        name="View agreement", default=NO_AGREEMENT,
        description="Share of the views' judgements that put it together with the instance's other masks; "
        "-1 when views did not decide",
    )  # fmt: skip
    pixels: IntProperty(name="Pixels", description="Pixels with depth, at the size of the lift")  # type: ignore[valid-type]
    share: FloatProperty(name="Share", description="Share of the picture's pixels")  # type: ignore[valid-type]
    rectangle: FloatVectorProperty(name="Rectangle", size=4)  # type: ignore[valid-type]
    reason: StringProperty(name="Why", description="Why it was matched, in words")  # type: ignore[valid-type]


class PLGS_PG_instance(bpy.types.PropertyGroup):
    """One object of the lift."""

    name: StringProperty(name="Name")  # type: ignore[valid-type]
    instance_id: IntProperty(name="Id")  # type: ignore[valid-type]
    class_id: IntProperty(name="Class id")  # type: ignore[valid-type]
    class_name: StringProperty(name="Class")  # type: ignore[valid-type]
    colour: FloatVectorProperty(  # type: ignore[valid-type]
        name="Colour", subtype="COLOR_GAMMA", size=3, min=0.0, max=1.0, update=_colour,
        description="Colour of its box and of its points when it is selected",
    )  # fmt: skip
    points: IntProperty(name="Points", description="Semantic points that belong to it")  # type: ignore[valid-type]
    views: IntProperty(name="Views", description="Frames in which a mask saw it")  # type: ignore[valid-type]
    score: FloatProperty(name="Score", description="Mean score of its masks, 0 to 1")  # type: ignore[valid-type]
    visible: BoolProperty(  # type: ignore[valid-type]
        name="Visible", default=True, update=_show, description="Show its box, points and anchors"
    )
    masks: CollectionProperty(type=PLGS_PG_mask)  # type: ignore[valid-type]
    mask_index: IntProperty(name="Mask", default=-1)  # type: ignore[valid-type]
    best_mask: IntProperty(  # type: ignore[valid-type]
        name="Best mask", default=-1, description="The mask that sees most of it; -1 when masks are not known"
    )


class PLGS_PG_class(bpy.types.PropertyGroup):
    """One class that has points. `class_id` 0 are points without a class."""

    name: StringProperty(name="Name")  # type: ignore[valid-type]
    class_id: IntProperty(name="Id")  # type: ignore[valid-type]
    colour: FloatVectorProperty(  # type: ignore[valid-type]
        name="Colour", subtype="COLOR_GAMMA", size=3, min=0.0, max=1.0, update=_colour,
        description="Colour of its points, and of its boxes when these are coloured by class",
    )  # fmt: skip
    points: IntProperty(name="Points")  # type: ignore[valid-type]
    score: FloatProperty(name="Score", description="Mean confidence of its points, 0 to 1")  # type: ignore[valid-type]
    is_thing: BoolProperty(name="Thing", description="Comes in instances")  # type: ignore[valid-type]
    visible: BoolProperty(  # type: ignore[valid-type]
        name="Visible", default=True, update=_show, description="Show its points, anchors and boxes"
    )


class PLGS_PG_lift(bpy.types.PropertyGroup):
    """`collection.plgs` of a lift's collection."""

    instances: CollectionProperty(type=PLGS_PG_instance)  # type: ignore[valid-type]
    instance_index: IntProperty(name="Instance", default=-1, update=_choose)  # type: ignore[valid-type]
    classes: CollectionProperty(type=PLGS_PG_class)  # type: ignore[valid-type]
    class_index: IntProperty(name="Class", default=-1)  # type: ignore[valid-type]
    instances_search: StringProperty(  # type: ignore[valid-type]
        name="Search", options={"TEXTEDIT_UPDATE"}, description="Show only instances whose names hold these words"
    )
    classes_search: StringProperty(  # type: ignore[valid-type]
        name="Search", options={"TEXTEDIT_UPDATE"}, description="Show only classes whose names hold these words"
    )
    isolated: IntProperty(  # type: ignore[valid-type]
        name="Shown alone", default=0, update=_show, description="Id of the only instance that is shown; 0 = all are"
    )
    box_colours: EnumProperty(  # type: ignore[valid-type]
        name="Boxes",
        items=[
            ("INSTANCE", "Instance", "Each box in a colour of its own"),
            ("CLASS", "Class", "Boxes in the colours of their classes"),
        ],
        update=_colour,
        description="What the boxes' colours tell",
    )
    show_labels: BoolProperty(  # type: ignore[valid-type]
        name="Labels", update=_name_boxes, description="Draw the instances' names over the view"
    )
    show_legend: BoolProperty(  # type: ignore[valid-type]
        name="Legend", description="Draw the classes and their colours over the view"
    )
    show_selected: BoolProperty(  # type: ignore[valid-type]
        name="Selected points", default=True, description="Highlight the points and anchors of the selected instance"
    )
    dim_others: BoolProperty(  # type: ignore[valid-type]
        name="Dim the rest", default=True, description="While an instance is selected, darken everything else"
    )


CLASSES = (PLGS_PG_mask, PLGS_PG_instance, PLGS_PG_class, PLGS_PG_lift)


def register() -> None:
    bpy.types.Collection.plgs = PointerProperty(type=PLGS_PG_lift)


def unregister() -> None:
    del bpy.types.Collection.plgs


@contextmanager
def registered() -> Iterator[None]:
    """Make `collection.plgs` known where the extension is switched off, as in scripts. What is written stays in the
    file either way.
    """
    if hasattr(bpy.types.Collection, "plgs"):
        yield
        return
    for each in CLASSES:
        bpy.utils.register_class(each)
    register()
    try:
        yield
    finally:
        unregister()
        for each in reversed(CLASSES):
            bpy.utils.unregister_class(each)
