"""Which colours a lift has in the view, and how it is shown.

Everything is drawn with the attribute Col. The photo's colours are kept in the attribute `photo` while Col shows
something else, so materials, Solid shading and renders need to know only one attribute.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..lift_collection import is_child
from ..materials import LIT, linear_rgba, value_node
from ..native_splats import dye
from ..owned import LIFT, key_of
from .lookup import ids_of, objects_by_key

PHOTO, CLASSES, INSTANCES, UNCERTAINTY = "PHOTO", "CLASSES", "INSTANCES", "UNCERTAINTY"
"""Values of a lift's `look`."""
POINTS, SPLATS, SURFACE = "POINTS", "SPLATS", "SURFACE"
"""Values of a lift's `show_as`."""
SHOWN_IN = {POINTS: "Semantic points", SPLATS: "Gaussians", SURFACE: "Meshes"}
"""The collection of what each of them shows."""
COLOUR, KEPT = "Col", "photo"

_GREY = np.array([0.3, 0.6, 0.1], np.float32)
"""Weights of the channels in the grey of what is not an instance."""
_RAMP = np.array([[0.02, 0.03, 0.09], [0.45, 0.05, 0.25], [1.0, 0.75, 0.15]], np.float32)
"""Linear colours of confidence 1, 0.5 and 0."""
SURENESS = (("sure", (0.15, 0.19, 0.33)), ("in doubt", (0.7, 0.25, 0.54)), ("unknown", (1.0, 0.88, 0.42)))
"""The legend of these colours, in sRGB."""
_CELL = 0.1
"""Metres: surfaces and splats are as sure as the points in their cell of this side."""


def apply_look(root: bpy.types.Collection) -> None:
    """Colour points, splats and meshes as the lift's `look` says."""
    look = root.plgs.look
    coloured = [ob for ob in objects_by_key(root).values() if _has_colours(ob)]
    sure = _Sureness(coloured) if look == UNCERTAINTY else None
    palette = {}
    if look in (CLASSES, INSTANCES):
        rows, name = (root.plgs.classes, "class_id") if look == CLASSES else (root.plgs.instances, "instance_id")
        palette = {getattr(row, name): _linear(row.colour) for row in rows}
    for ob in coloured:
        photo = _photo(ob.data)
        if look == CLASSES:
            colours = _by_id(ids_of(ob.data, "class_id"), palette, photo)
        elif look == INSTANCES:
            colours = _by_id(ids_of(ob.data, "instance_id"), palette, photo)
        elif sure is not None:
            colours = sure.colours(ob)
        else:
            colours = photo
        _write(ob.data, COLOUR, colours)
        dye(ob.data)
        kept = ob.data.attributes.get(KEPT)
        if look == PHOTO and kept is not None:
            ob.data.attributes.remove(kept)
        ob.data.update_tag()


def apply_lit(root: bpy.types.Collection) -> None:
    """Let the scene's lights light the lift's meshes, or the photos' own light, as the lift's `lit` says."""
    for material in bpy.data.materials:
        node = value_node(material, LIT) if key_of(material, root[LIFT]) is not None else None
        if node is not None:
            node.outputs[0].default_value = float(root.plgs.lit)


def apply_show_as(root: bpy.types.Collection) -> None:
    """Show what the lift's `show_as` says, and hide the others, in views and in renders."""
    for kind, name in SHOWN_IN.items():
        for child in root.children:
            if is_child(child, root, name):
                child.hide_viewport = child.hide_render = kind != root.plgs.show_as


def has(root: bpy.types.Collection, kind: str) -> bool:
    """Whether the lift has what one of `show_as` shows."""
    return any(is_child(child, root, SHOWN_IN[kind]) and len(child.all_objects) for child in root.children)


def _has_colours(ob: bpy.types.Object) -> bool:
    return ob.type in ("POINTCLOUD", "MESH") and COLOUR in ob.data.attributes and "class_id" in ob.data.attributes


def _photo(data: Any) -> NDArray[np.float32]:
    """The photo's linear colours float32 [N, 4]. From the first call on they are kept apart from Col."""
    if KEPT in data.attributes:
        return _read(data, KEPT)
    colours = _read(data, COLOUR)
    layer = data.attributes.new(KEPT, data.attributes[COLOUR].data_type, "POINT")
    if data.id_type == "MESH":  # a new colour attribute must not become the active one
        data.color_attributes.active_color = data.color_attributes[COLOUR]
    layer.data.foreach_set("color", colours.ravel())
    return colours


def _read(data: Any, name: str) -> NDArray[np.float32]:
    values = np.empty(4 * len(data.attributes[name].data), np.float32)
    data.attributes[name].data.foreach_get("color", values)
    return values.reshape(-1, 4)


def _write(data: Any, name: str, colours: NDArray[np.float32]) -> None:
    data.attributes[name].data.foreach_set("color", np.ascontiguousarray(colours, np.float32).ravel())


def _linear(srgb: Any) -> NDArray[np.float32]:
    return linear_rgba([round(255.0 * channel) for channel in srgb])


def _by_id(
    ids: NDArray[np.int32], palette: dict[int, NDArray[np.float32]], photo: NDArray[np.float32]
) -> NDArray[np.float32]:
    """The colours [N, 4] of ids [N]; a dark grey photo where the palette has none."""
    colours = np.ones_like(photo)
    colours[:, :3] = 0.35 * (photo[:, :3] @ _GREY)[:, None]
    for number, colour in palette.items():
        colours[ids == number] = colour
    return colours


class _Sureness:
    """How sure the views were of what is at a place."""

    def __init__(self, coloured: list[bpy.types.Object]) -> None:
        clouds = [ob for ob in coloured if "confidence" in ob.data.attributes]
        cells = _cells(np.concatenate([places(ob.data) for ob in clouds])) if clouds else np.zeros(0, np.int64)
        sure = np.concatenate([_confidence(ob.data) for ob in clouds]) if clouds else np.zeros(0, np.float32)
        self._cells, rows, count = np.unique(cells, return_inverse=True, return_counts=True)
        self._mean = np.bincount(rows.ravel(), sure, len(self._cells)) / np.maximum(count, 1)

    def colours(self, ob: bpy.types.Object) -> NDArray[np.float32]:
        """Linear colours float32 [N, 4], brighter where the views were less sure; dark where there are no points."""
        if "confidence" in ob.data.attributes:
            sure = _confidence(ob.data)
        else:
            cells = _cells(places(ob.data))
            at = np.minimum(np.searchsorted(self._cells, cells), max(len(self._cells) - 1, 0))
            known = self._cells[at] == cells if len(self._cells) else np.zeros(len(cells), bool)
            sure = np.where(known, self._mean[at] if len(self._mean) else 1.0, 1.0)
        colours = np.ones((len(sure), 4), np.float32)
        for channel in range(3):
            colours[:, channel] = np.interp(1.0 - sure, (0.0, 0.5, 1.0), _RAMP[:, channel])
        return colours


def _confidence(data: Any) -> NDArray[np.float32]:
    values = np.empty(len(data.attributes["confidence"].data), np.float32)
    data.attributes["confidence"].data.foreach_get("value", values)
    return np.clip(np.nan_to_num(values), 0.0, 1.0)


def places(data: Any) -> NDArray[np.float32]:
    """The positions of a cloud's points or a mesh's vertices, float32 [N, 3] in metres."""
    values = np.empty(3 * len(data.attributes["position"].data), np.float32)
    data.attributes["position"].data.foreach_get("vector", values)
    return values.reshape(-1, 3)


def _cells(xyz: NDArray[np.float32]) -> NDArray[np.int64]:
    """The number of each place's cell, int64 [N]. Rooms farther than 100 km from the origin have no cells of their own.
    """
    x, y, z = (np.floor(xyz / _CELL).astype(np.int64) + (1 << 20)).T
    return (x << 42) | (y << 21) | z
