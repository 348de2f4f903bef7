"""The panel "3 Result": the searchable lists of a lift's instances, classes and masks, and how they are shown."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import EnumProperty

from ..plgs_blender import registry, viewport
from ..plgs_blender.compat import STORED_COLOURS
from ..plgs_blender.corrections import failed, outdated
from ..plgs_blender.errors import one_line, plural
from ..plgs_blender.inspecting.drawing import is_rest
from ..plgs_blender.inspecting.looks import BY_CLASS, POINTS, SPLATS, SURFACE, has
from ..plgs_blender.inspecting.selection import active_lift, chosen_row
from ..plgs_blender.meshes import are_stale
from ..plgs_blender.owned import ESTIMATED, LIFT, folder_of, gone, layer_collections, lifts_in, text_of
from ..plgs_blender.running.exports import Export, making_meshes
from .sidebar import Sidebar, Step, draw_bar, draw_task, draw_text, fitted, from_panel

_SORTS = [
    ("NAME", "Name", "Alphabetical"),
    ("COUNT", "Points", "Most points first"),
    ("SCORE", "Confidence", "Most certain first; 1 is certain"),
]


class Searchable:
    """A list that can be searched and sorted. The search words are in the lift's `<list>_search`."""

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
    """Return `flag` for each name that contains all words of `search`, ignoring case, and 0 for the others."""
    words = search.casefold().split()
    return [flag if all(word in name.casefold() for word in words) else 0 for name in names]


def places_of(rows: Any, order: str) -> list[int]:
    """Return each row's position in the order NAME (2 before 10), COUNT or SCORE. "Other" classes come last."""
    keys = {"NAME": _by_name, "COUNT": lambda row: -row.points, "SCORE": lambda row: -row.score}
    places = [0] * len(rows)
    ranks = [(is_rest(getattr(row, "class_name", row.name)), keys[order](row)) for row in rows]
    for place, index in enumerate(sorted(range(len(rows)), key=ranks.__getitem__)):
        places[index] = place
    return places


def _by_name(row: Any) -> tuple[str, int]:
    head, _, number = row.name.rpartition(" ")
    return (head.casefold(), int(number)) if number.isdecimal() else (row.name.casefold(), 0)


def short_count(number: int) -> str:
    """Return a count below ten million in at most four characters: 950, 9.5k, 27k, 1.2M."""
    for unit, letter in ((1_000_000, "M"), (1_000, "k")):
        if number >= unit:
            # From 9.95 on, ".1f" would give a fifth character: 10.0k.
            return f"{number / unit:.1f}{letter}" if number < 9.95 * unit else f"{number / unit:.0f}{letter}"
    return str(number)


def _swatch_name_numbers(layout: Any, row: Any, coloured: Any, *, can_be_renamed: bool) -> Any:
    """Draw a row's first cells: the colour of `coloured` (row or class), name, numbers. Returns the layout for more."""
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


def _draw_eye(line: Any, row: Any) -> None:
    line.prop(row, "visible", text="", icon="HIDE_OFF" if row.visible else "HIDE_ON", emboss=False)


def swatch_of(lists: Any, row: Any) -> Any:
    """Return the row whose colour an instance has in the view: its class's if colours are by class, else its own."""
    if lists.look != BY_CLASS:
        return row
    return next((each for each in lists.classes if each.class_id == row.class_id), row)


class PLGS_UL_instances(Searchable, bpy.types.UIList):
    order: EnumProperty(name="Order", items=_SORTS)

    def draw_item(self, _context: Any, layout: Any, lists: Any, row: Any, _icon: int, _active: Any, _name: str) -> None:
        line = _swatch_name_numbers(layout, row, swatch_of(lists, row), can_be_renamed=True)
        select = line.operator("plgs.select_instance", text="", icon="RESTRICT_SELECT_OFF", emboss=False)
        select.instance = row.instance_id
        _draw_eye(line, row)


class PLGS_UL_classes(Searchable, bpy.types.UIList):
    order: EnumProperty(name="Order", items=_SORTS, default="COUNT")

    def draw_item(
        self, _context: Any, layout: Any, _lists: Any, row: Any, _icon: int, _active: Any, _name: str
    ) -> None:
        line = _swatch_name_numbers(layout, row, row, can_be_renamed=False)
        if row.is_thing:
            select = line.operator("plgs.select_class", text="", icon="RESTRICT_SELECT_OFF", emboss=False)
            select.class_id = row.class_id
        else:  # stuff has no boxes
            line.label(text="", icon="BLANK1")
        _draw_eye(line, row)


class PLGS_UL_masks(bpy.types.UIList):
    """The masks that were matched to an instance; a click on a frame looks through its camera."""

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
        return shown_rows(names, self.filter_name, self.bitflag_filter_item), []  # []: in their own order


_SURFACE_FROM = 0.55
"""Where the surface's button begins in its row; there must be room for its progress and a button at its end."""


def _lift(context: bpy.types.Context) -> Any:
    """Return the lift shown in the panels, or None before the first lift."""
    root = active_lift(context.scene, context.active_object)
    return root if root is not None and len(root.plgs.classes) else None


class PLGS_PT_result(Step, bpy.types.Panel):
    bl_idname, bl_label, bl_order = "PLGS_PT_result", "3  Result", 30

    def draw(self, context: bpy.types.Context) -> None:
        layout, root = self.layout, _lift(context)
        if root is None:
            draw_text(layout, context, "Nothing has been lifted yet. Start a lift, or open a finished one", "INFO")
            layout.operator("plgs.open_lift", text="Open Lift…", icon="FILE_FOLDER")
            return
        lists, row = root.plgs, chosen_row(context.scene, context.active_object)
        title = layout.row()
        title.label(text=one_line(root.name), icon="OUTLINER_COLLECTION")
        if context.space_data is not None:  # hides all that is drawn over the view; its key is Shift Alt Z
            title.prop(context.space_data.overlay, "show_overlays", text="", icon="OVERLAY")
            if viewport.draws_in_software():
                layout.label(text=fitted(context, "No GPU: Solid shading is fastest"), icon="INFO")
        _draw_chooser(layout, context, root)
        if root[LIFT] in gone:
            draw_text(layout, context, f"The lift was moved away from {folder_of(root)}", "ERROR")
            layout.operator("plgs.find_lift", text="Find Lift…", icon="VIEWZOOM")
        elif root[LIFT] in outdated:
            draw_text(layout, context, "The lift on disk differs from what is shown", "INFO")
            anew = layout.operator("plgs.place_lift", text="Show It Anew", icon="FILE_REFRESH")
            anew.lift_folder = str(folder_of(root))
        for line in failed:
            draw_text(layout, context, line, "ERROR")
        for line in text_of(root, ESTIMATED).splitlines():
            draw_text(layout, context, f"{line[:1].upper()}{line[1:]}", "INFO")
        _draw_look(from_panel(layout.column(align=True), context), context, root)
        layout.prop(lists, "instances_search", text="", icon="VIEWZOOM")
        _draw_heads(layout, "Name", "Points, confidence")
        layout.template_list("PLGS_UL_instances", "", lists, "instances", lists, "instance_index", rows=6)
        if not len(lists.instances):
            layout.label(text="No instances were found", icon="INFO")
            return
        column = from_panel(layout.column(align=True), context)
        column.operator("plgs.frame_instance", icon="ZOOM_SELECTED")
        is_alone = lists.isolated > 0 and (row is None or lists.isolated == row.instance_id)
        text, icon = ("Exit Isolation", "SOLO_ON") if is_alone else ("Isolate", "SOLO_OFF")
        column.operator("plgs.isolate_instance", text=text, icon=icon, depress=is_alone)
        column.operator("plgs.go_to_best_view", icon="VIEW_CAMERA")
        column.operator("plgs.matte_instance", icon="IMAGE_ALPHA")
        layout.operator("plgs.show_all", icon="HIDE_OFF")
        made = registry.latest(Export)
        if made is not None and made.makes_meshes and not made.is_running:
            draw_task(layout, context, made)


def _draw_chooser(layout: bpy.types.UILayout, context: bpy.types.Context, chosen: bpy.types.Collection) -> None:
    """If the scene has several lifts, draw which of them the panels show, and the eye and camera of each."""
    roots = [root for root in lifts_in(context.scene) if len(root.plgs.classes)]
    layers = layer_collections(context.view_layer.layer_collection) if len(roots) > 1 else []
    for layer in (layer for layer in layers if layer.collection in roots):
        row = layout.row(align=True)
        name, icon = layer.collection.name, "RADIOBUT_ON" if layer.collection == chosen else "RADIOBUT_OFF"
        row.operator("plgs.choose_lift", text=one_line(name), icon=icon, emboss=False).lift = name
        row.prop(layer, "hide_viewport", text="", emboss=False)
        row.prop(layer.collection, "hide_render", text="", emboss=False)


def _draw_heads(layout: bpy.types.UILayout, left: str, right: str) -> None:
    heads = layout.row().split(factor=0.5)
    heads.label(text=left)
    numbers = heads.row()
    numbers.alignment = "CENTER"
    numbers.label(text=right)


def _draw_look(column: bpy.types.UILayout, context: bpy.types.Context, root: bpy.types.Collection) -> None:
    column.grid_flow(row_major=True, columns=2, even_columns=True, align=True).prop(root.plgs, "look", expand=True)
    row = column.split(factor=_SURFACE_FROM, align=True)
    others = row.row(align=True)
    for kind, label in ((POINTS, "Points"), (SPLATS, "Splats")):
        others.operator("plgs.show_as", text=label, depress=root.plgs.show_as == kind).kind = kind
    _draw_surface(row.row(align=True), root)


def _draw_surface(cell: bpy.types.UILayout, root: bpy.types.Collection) -> None:
    """Draw the surface's button or, in its place, the engine's progress, so that the list below does not move."""
    if draw_bar(cell, making_meshes(), "Surface"):
        return
    if not has(root, SURFACE):
        cell.operator("plgs.make_meshes", text="Surface")
    else:
        cell.operator("plgs.show_as", text="Surface", depress=root.plgs.show_as == SURFACE).kind = SURFACE
        if are_stale(root):
            cell.operator("plgs.make_meshes", text="", icon="FILE_REFRESH")


class OfResult(Sidebar):
    """A subpanel of the result's panel, closed at first and shown once something has been lifted."""

    bl_parent_id, bl_options = "PLGS_PT_result", {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _lift(context) is not None


class PLGS_PT_name(bpy.types.Panel):
    """The popup of F2: the name of the chosen instance, ready for typing."""

    bl_idname, bl_label, bl_space_type, bl_region_type = "PLGS_PT_name", "Rename Object", "TOPBAR", "HEADER"
    bl_ui_units_x = 14

    def draw(self, context: bpy.types.Context) -> None:
        row = chosen_row(context.scene, context.active_object)
        if row is not None:
            self.layout.label(text="Rename Object")
            field = self.layout.row()
            field.activate_init = True
            field.prop(row, "name", text="")


class PLGS_PT_masks(OfResult, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_masks", "Source Masks"

    def draw(self, context: bpy.types.Context) -> None:
        layout, row = self.layout, chosen_row(context.scene, context.active_object)
        if row is None:
            draw_text(layout, context, "Click an object in the view, or a row of the list", "INFO")
            return
        if not len(row.masks):
            draw_text(layout, context, "This lift did not record its masks. Lift again to see them", "INFO")
            return
        draw_text(layout, context, f"{row.name}: {plural(len(row.masks), 'mask')} in {plural(row.views, 'frame')}")
        _draw_heads(layout, "Frame, class", "Confidence, match")
        layout.template_list("PLGS_UL_masks", "", row, "masks", row, "mask_index", rows=5, maxrows=12)
        if row.best_mask < 0:
            draw_text(layout, context, "Lift again to see where the masks are and why they were matched", "INFO")
        elif 0 <= row.mask_index < len(row.masks):
            mask = row.masks[row.mask_index]
            share = f"{100.0 * mask.share:.1f} % of the picture"
            draw_text(layout, context, f"Segment {mask.segment}, {plural(mask.pixels, 'pixel')}, {share}")


class PLGS_PT_classes(OfResult, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_classes", "Classes"

    def draw(self, context: bpy.types.Context) -> None:
        lists = _lift(context).plgs
        self.layout.prop(lists, "classes_search", text="", icon="VIEWZOOM")
        _draw_heads(self.layout, "Name", "Points, confidence")
        self.layout.template_list("PLGS_UL_classes", "", lists, "classes", lists, "class_index", rows=6)
        if 0 <= lists.class_index < len(lists.classes):
            matte = self.layout.operator("plgs.matte_class", icon="IMAGE_ALPHA")
            matte.class_id = lists.classes[lists.class_index].class_id


class PLGS_PT_not_shown(OfResult, bpy.types.Panel):
    """Objects that the masks show well from close up but the lift lacks."""

    bl_idname, bl_label = "PLGS_PT_not_shown", "Not Shown"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        root = _lift(context)
        return root is not None and len(root.plgs.not_shown) > 0

    def draw(self, context: bpy.types.Context) -> None:
        for row in _lift(context).plgs.not_shown:
            draw_text(self.layout, context, row.name, "HIDE_ON")
            line = from_panel(self.layout.row(), context)
            line.operator("plgs.go_to_frame", text=f"Frame {one_line(row.frame)}").frame = row.frame


class PLGS_PT_result_display(OfResult, bpy.types.Panel):
    bl_idname, bl_label = "PLGS_PT_result_display", "Display"

    def draw(self, context: bpy.types.Context) -> None:
        layout, lists = self.layout, _lift(context).plgs
        layout.operator("plgs.show_colours", icon="SHADING_SOLID")
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(lists, "lit")
        layout.prop(lists, "catch_shadows")
        if context.scene.view_settings.view_transform not in STORED_COLOURS:
            draw_text(layout, context, "This view transform changes the photos' colours:", "INFO")
            layout.prop(context.scene.view_settings, "view_transform")
        column = layout.column(heading="Draw")
        for name in ("show_labels", "show_legend", "show_boxes", "show_cameras", "show_selected"):
            column.prop(lists, name)
