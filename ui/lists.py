"""The searchable lists of a lift: its instances, its classes, and the masks of an instance."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import EnumProperty

from ..plgs_blender.errors import one_line
from ..plgs_blender.inspecting.looks import CLASSES as BY_CLASS

_SORTS = [
    ("NAME", "Name", "In alphabetical order"),
    ("COUNT", "Points", "Those with the most points first"),
    ("SCORE", "Score", "The highest score first"),
]


class Searchable:
    """A list with a choice of orders. The lift's `<list>_search` holds the words that are searched for."""

    order: Any
    bitflag_filter_item: int
    """Blender's flag for a row that is shown."""

    def draw_filter(self, _context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        row = layout.row(align=True)
        row.prop(self, "order", expand=True)
        row.prop(self, "use_filter_sort_reverse", text="", icon="SORT_ASC")

    def filter_items(self, _context: bpy.types.Context, data: Any, name: str) -> tuple[list[int], list[int]]:
        rows = getattr(data, name)
        search = getattr(data, f"{name}_search")
        return shown_rows([row.name for row in rows], search, self.bitflag_filter_item), places_of(rows, self.order)


def shown_rows(names: list[str], search: str, flag: int) -> list[int]:
    """`flag` for each name that contains all words of `search`, ignoring case, and 0 for the others."""
    words = search.casefold().split()
    return [flag if all(word in name.casefold() for word in words) else 0 for name in names]


def places_of(rows: Any, order: str) -> list[int]:
    """The place of each row in the order NAME, COUNT or SCORE. Numbers in names count as numbers: 2 before 10."""
    keys = {"NAME": _by_name, "COUNT": lambda row: -row.points, "SCORE": lambda row: -row.score}
    places = [0] * len(rows)
    for place, index in enumerate(sorted(range(len(rows)), key=lambda index: keys[order](rows[index]))):
        places[index] = place
    return places


def _by_name(row: Any) -> tuple[str, int]:
    head, _, number = row.name.rpartition(" ")
    return (head.casefold(), int(number)) if number.isdecimal() else (row.name.casefold(), 0)


def short_count(number: int) -> str:
    """A count in at most four characters, up to ten million: 950, 9.5k, 27k, 1.2M."""
    for unit, letter in ((1_000_000, "M"), (1_000, "k")):
        if number >= unit:
            return f"{number / unit:.1f}{letter}" if number < 9.95 * unit else f"{number / unit:.0f}{letter}"
    return str(number)


def _swatch_name_numbers(layout: Any, row: Any, coloured: Any, *, can_be_renamed: bool) -> Any:
    """Draw the beginning of an instance's or a class's row, with the colour of `coloured`: the row itself or its
    class's. Returns the layout for the rest.
    """
    line = layout.row(align=True)
    swatch = line.row()
    swatch.ui_units_x = 0.9
    swatch.prop(coloured, "colour", text="")
    split = line.split(factor=0.56, align=True)
    if can_be_renamed:
        split.prop(row, "name", text="", emboss=False)
    else:
        split.label(text=one_line(row.name))
    numbers = split.row()
    numbers.alignment = "RIGHT"
    numbers.label(text=f"{short_count(row.points)} {row.score:.2f}")
    return line


def swatch_of(lists: Any, row: Any) -> Any:
    """The row whose colour an instance has in the view: its class's while classes are shown, else its own."""
    if lists.look != BY_CLASS:
        return row
    return next((each for each in lists.classes if each.class_id == row.class_id), row)


class PLGS_UL_instances(Searchable, bpy.types.UIList):
    """Instances: eye, colour, name, points, score, select."""

    order: EnumProperty(name="Order", items=_SORTS)  # type: ignore[valid-type]

    def draw_item(
        self, _context: Any, layout: Any, lists: Any, row: Any, _icon: int, _active: Any, _name: str
    ) -> None:
        line = _swatch_name_numbers(layout, row, swatch_of(lists, row), can_be_renamed=True)
        select = line.operator("plgs.select_instance", text="", icon="RESTRICT_SELECT_OFF", emboss=False)
        select.instance = row.instance_id
        line.prop(row, "visible", text="", icon="HIDE_OFF" if row.visible else "HIDE_ON", emboss=False)


class PLGS_UL_classes(Searchable, bpy.types.UIList):
    """Classes: eye, colour, name, points, score, select."""

    order: EnumProperty(name="Order", items=_SORTS, default="COUNT")  # type: ignore[valid-type]

    def draw_item(
        self, _context: Any, layout: Any, _lists: Any, row: Any, _icon: int, _active: Any, _name: str
    ) -> None:
        line = _swatch_name_numbers(layout, row, row, can_be_renamed=False)
        if row.is_thing:
            select = line.operator("plgs.select_class", text="", icon="RESTRICT_SELECT_OFF", emboss=False)
            select.class_id = row.class_id
        else:  # stuff has no boxes
            line.label(text="", icon="BLANK1")
        line.prop(row, "visible", text="", icon="HIDE_OFF" if row.visible else "HIDE_ON", emboss=False)


class PLGS_UL_masks(bpy.types.UIList):
    """The masks that made an instance: a click on the frame looks through its camera."""

    def draw_item(
        self, _context: Any, layout: Any, instance: Any, mask: Any, _icon: int, _active: Any, _name: str, index: int
    ) -> None:
        is_best = index == instance.best_mask
        line = layout.row(align=True)
        frame = line.row(align=True)
        frame.ui_units_x = 4.0
        jump = frame.operator(
            "plgs.go_to_mask", text=one_line(mask.frame), icon="SOLO_ON" if is_best else "OUTLINER_OB_CAMERA"
        )
        jump.instance, jump.frame, jump.segment = instance.instance_id, mask.frame, mask.segment
        split = line.split(factor=0.45, align=True)
        named = split.row()
        named.alert = mask.class_id != instance.class_id
        named.label(text=one_line(mask.class_name))
        numbers = split.row()
        numbers.alignment = "RIGHT"
        numbers.label(text=f"{mask.score:.2f}")
        numbers.label(text=one_line(mask.reason))

    def filter_items(self, _context: bpy.types.Context, data: Any, name: str) -> tuple[list[int], list[int]]:
        rows = getattr(data, name)
        names = [f"{mask.frame} {mask.class_name}" for mask in rows]
        return shown_rows(names, self.filter_name, self.bitflag_filter_item), []


CLASSES = (PLGS_UL_instances, PLGS_UL_classes, PLGS_UL_masks)
