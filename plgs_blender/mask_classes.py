"""The classes of the scene's masks as rows that the panel edits: `scene.plgs_masks`."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import BoolProperty, CollectionProperty, IntProperty, PointerProperty, StringProperty

from ..engine.errors import PlgsError
from ..engine.job import write_atomically
from ..engine.scene import TABLES, NamedClass, class_list_path, class_list_text, list_classes
from .chosen_scene import ChosenScene
from .paths import absolute

OWN_TABLE = "OWN"
TABLE_ITEMS = [
    (OWN_TABLE, "The masks' own", "As their files say"),
    *((name, name, f"Begin with the classes of {name}") for name in TABLES),
]


class PLGS_PG_mask_class(bpy.types.PropertyGroup):
    """One class of the masks. `into` names the class that it counts as; empty: itself."""

    label: IntProperty(name="Number", description="Its number in the masks")
    into: StringProperty(
        name="Counts as", description="The class that it is merged into; void: it is dropped; empty: it stays"
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
        name="Model", description="A folder with a Mask2Former, or its name on Hugging Face's hub; empty: the usual one"
    )


def fill_classes(masks: PLGS_PG_masks, place: ChosenScene, table: str = OWN_TABLE) -> None:
    """Read the classes of the scene's masks into the rows. Raises PlgsError."""
    listed = list_classes(place.scene, place.masks, place.scene_format, table=None if table == OWN_TABLE else table)
    masks.classes.clear()
    masks.path, masks.active = str(listed.path), 0
    masks.void = " ".join(map(str, sorted(listed.void)))
    for each in listed.rows:
        row = masks.classes.add()
        row.name, row.label, row.is_thing = each.name, each.label, each.is_thing
        row.into = "" if each.into == each.name else each.into


def write_classes(masks: PLGS_PG_masks, place: ChosenScene) -> Path:
    """Write the rows into the classes.toml beside the masks of ``place``. Raises PlgsError, OSError.

    A .blend may come from somebody else and name any file, so the place of the list is worked out anew.
    """
    if not len(masks.classes):
        raise PlgsError("there are no classes to write", "Classes", "Read them from the masks first.")
    rows = [NamedClass(row.label, row.name, row.into or row.name, row.is_thing) for row in masks.classes]
    if not all(row.name.isprintable() and row.name and row.into.isprintable() for row in rows):
        raise PlgsError("a class has no name", "Classes", "Give each a name of one line.")
    path = class_list_path(place.scene, place.masks)
    if absolute(masks.path) != path:
        raise PlgsError("the list is of another scene", path, "Read the classes again.")
    write_atomically(path, class_list_text(rows, _void(masks)))
    return path


def _void(masks: PLGS_PG_masks) -> frozenset[int]:
    """The numbers that mean nothing. Raises PlgsError."""
    try:
        return frozenset(map(int, masks.void.split()))
    except ValueError as error:
        raise PlgsError("the numbers of void cannot be read", masks.void, "Read the classes again.") from error


CLASSES = (PLGS_PG_mask_class, PLGS_PG_masks)


def register() -> None:
    bpy.types.Scene.plgs_masks = PointerProperty(type=PLGS_PG_masks)


def unregister() -> None:
    del bpy.types.Scene.plgs_masks
