"""The classes of the scene's masks as rows that the panel edits: `scene.plgs_masks`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bpy
from bpy.props import BoolProperty, CollectionProperty, IntProperty, PointerProperty, StringProperty

from ..engine.errors import PlgsError
from ..engine.posed.format_names import NUMBERINGS, TABLES
from .paths import absolute

OWN_TABLE = "OWN"
TABLE_ITEMS = [
    (OWN_TABLE, "The masks' own", "As their files say"),
    *((name, name, f"Start from the classes of {name}") for name in (*TABLES, *NUMBERINGS)),
]


class PLGS_PG_mask_class(bpy.types.PropertyGroup):
    """One class of the masks. `into` names the class that it counts as; empty: itself."""

    label: IntProperty(name="Number", description="Its number in the masks")
    into: StringProperty(
        name="Counts As", description="The class that it is merged into; void: it is dropped; empty: it stays"
    )
    is_thing: BoolProperty(
        name="Thing", description="Countable objects, such as chairs; stuff, such as walls, has no instances"
    )


class PLGS_PG_masks(bpy.types.PropertyGroup):
    """`scene.plgs_masks`: the list of classes, the file that it goes into, and the network that makes masks."""

    classes: CollectionProperty(type=PLGS_PG_mask_class)
    active: IntProperty()
    path: StringProperty()
    void: StringProperty()
    model: StringProperty(
        name="Model", description="A folder with a Mask2Former, or its name on the Hugging Face Hub; empty: the default"
    )


def fill_classes(masks: PLGS_PG_masks, listed: Mapping[str, Any]) -> None:
    """Put the answer of the engine's command ``classes`` into the rows. Raises ValueError, TypeError, KeyError."""
    masks.classes.clear()
    masks.path, masks.active = str(listed["path"]), 0
    masks.void = " ".join(str(int(number)) for number in listed.get("void", ()))
    for each in listed["rows"]:
        row = masks.classes.add()
        row.name, row.label, row.is_thing = str(each["name"]), int(each["label"]), bool(each["is_thing"])
        row.into = "" if each["into"] == each["name"] else str(each["into"])


def edited_classes(masks: PLGS_PG_masks) -> dict[str, Any]:
    """The rows as the engine's command ``classes --write`` takes them. Raises PlgsError."""
    rows = [
        {"label": row.label, "name": row.name, "into": row.into or row.name, "is_thing": row.is_thing}
        for row in masks.classes
    ]
    try:
        void = [int(word) for word in masks.void.split()]
    except ValueError as error:
        raise PlgsError("the numbers of void cannot be read", masks.void, "Read the classes again.") from error
    return {"path": str(absolute(masks.path)), "rows": rows, "void": void}


CLASSES = (PLGS_PG_mask_class, PLGS_PG_masks)


def register() -> None:
    bpy.types.Scene.plgs_masks = PointerProperty(type=PLGS_PG_masks)


def unregister() -> None:
    del bpy.types.Scene.plgs_masks
