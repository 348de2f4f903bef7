"""Give an unchanged startup file a capture's range, size, camera and colours; a user's own file keeps its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from .cameras import pixel_aspect
from .compat import show_stored_colours
from .owned import KEY, LIFT, lifts_in
from .timeline import places_of
from .viewport import areas_of

_STARTUP_LOCATIONS = {
    "MESH": (0.0, 0.0, 0.0),
    "CAMERA": (7.35889, -6.92579, 4.95831),
    "LIGHT": (4.07625, 1.00545, 5.90386),
}
"""Positions of the cube, camera and light in Blender's startup file, in metres."""
_RANGE, _SIZE, _ASPECT = (1, 250), (1920, 1080, 100), (1.0, 1.0)


@contextmanager
def taking_over(scene: bpy.types.Scene) -> Iterator[bool]:
    """Wrap the placing of a capture or lift; yields whether the scene is an unchanged startup scene. Such a scene takes
    the capture's range, size, pixel aspect, camera and colours, and its own objects are hidden. In another scene, the
    range follows the lift's frames if it was theirs before. If placing fails, everything is restored."""
    is_untouched = _is_untouched(scene)
    follows = is_untouched or (scene.frame_start, scene.frame_end) == _span(scene)
    camera = scene.camera
    if is_untouched:
        _views[:] = [(area, _state(area.spaces.active)) for area in areas_of(scene)]
        scene.camera = None  # else our markers would come after the scene's range, and its camera stay active
    try:
        yield is_untouched
    except BaseException:
        scene.camera = camera
        raise
    span = _span(scene)
    if not follows or span is None:
        return
    if is_untouched:
        _hide_startup_objects(scene)
        _use_size(scene)
        show_stored_colours(scene)
    scene.frame_start, scene.frame_end = span
    numbers = _frame_numbers(scene)
    overview = next((number for ob, number in numbers.items() if "frame" not in ob), span[0])
    number = overview if is_untouched else numbers.get(camera, span[0])
    if (scene.frame_current, scene.camera) != (number, camera):  # else Blender would evaluate everything in vain
        scene.frame_set(number)


_views: list[tuple[bpy.types.Area, dict[str, Any]]] = []
"""The 3D views of the startup file, and how they looked before something was placed: undo leaves screens alone."""
_LOOKS = (
    "clip_start", "shading.type", "shading.light", "shading.color_type", "shading.show_backface_culling",
    "shading.wireframe_color_type", "shading.show_cavity", "shading.show_shadows", "shading.show_object_outline",
    "overlay.show_relationship_lines", "overlay.show_floor", "region_3d.view_perspective", "region_3d.view_rotation",
    "region_3d.view_location", "region_3d.view_distance",
)  # fmt: skip


def _state(space: bpy.types.SpaceView3D) -> dict[str, Any]:
    values = {name: space.path_resolve(name) for name in _LOOKS}
    return {name: value.copy() if hasattr(value, "copy") else value for name, value in values.items()}


@bpy.app.handlers.persistent
def _after_undo(*_arguments: object) -> None:
    """Restore the look of the views when undo has removed all that was placed."""
    if not _views or any(map(lifts_in, bpy.data.scenes)):
        return
    open_now = {area.as_pointer() for screen in bpy.data.screens for area in screen.areas}
    for area, state in _views if all(each.as_pointer() in open_now for each, _ in _views) else ():
        for name, value in state.items():
            owner, _, last = name.rpartition(".")
            space = area.spaces.active
            setattr(space.path_resolve(owner) if owner else space, last, value)
    _views.clear()


@bpy.app.handlers.persistent
def _after_loading(*_arguments: object) -> None:
    _views.clear()


HANDLERS = (("undo_post", _after_undo), ("load_post", _after_loading))


def _is_untouched(scene: bpy.types.Scene) -> bool:
    """Whether a scene is as in Blender's startup file, with all or some of its three objects."""
    render = scene.render
    size = (render.resolution_x, render.resolution_y, render.resolution_percentage)
    aspect = (render.pixel_aspect_x, render.pixel_aspect_y)
    span = (scene.frame_start, scene.frame_end)
    has_defaults = (span, size, aspect) == (_RANGE, _SIZE, _ASPECT) and not scene.timeline_markers
    is_new = not bpy.data.filepath and KEY not in scene and has_defaults
    return is_new and all(LIFT in ob or _is_startup_object(ob) for ob in scene.objects)  # a live preview is ours


def _is_startup_object(ob: bpy.types.Object) -> bool:
    location = _STARTUP_LOCATIONS.get(ob.type)
    if location is None or ob.animation_data is not None or len(ob.modifiers) or len(ob.constraints):
        return False
    is_there = (ob.location - Vector(location)).length < 1e-3 and ob.scale == Vector((1.0, 1.0, 1.0))
    if not is_there or ob.type != "MESH":
        return is_there
    xyz = np.array([vertex.co for vertex in ob.data.vertices]).reshape(-1, 3)
    return len(xyz) == 8 and bool((np.abs(xyz) == 1.0).all())  # the cube of two metres


def _hide_startup_objects(scene: bpy.types.Scene) -> None:
    """Hide all objects that belong to no lift in the views, and the meshes among them in renders, too."""
    for ob in scene.objects:
        if LIFT in ob:
            continue
        ob.hide_render = ob.hide_render or ob.type == "MESH"
        for layer in scene.view_layers:
            if ob.name in layer.objects:
                ob.hide_set(True, view_layer=layer)
                if layer.objects.active == ob:
                    layer.objects.active = None  # else editors show the properties of a hidden cube


def _use_size(scene: bpy.types.Scene) -> None:
    """Set the scene's size and pixel aspect to those of the first frame."""
    numbers = _frame_numbers(scene)
    frame = next((ob for ob in sorted(numbers, key=numbers.__getitem__) if "frame" in ob), None)
    if frame is not None:
        render = scene.render
        render.resolution_x, render.resolution_y = frame["width"], frame["height"]
        render.pixel_aspect_x, render.pixel_aspect_y = pixel_aspect(frame["fx"], frame["fy"])


def _span(scene: bpy.types.Scene) -> tuple[int, int] | None:
    """Return the first and last timeline frame of the frames' cameras, not the overview's; None without any."""
    numbers = [number for ob, number in _frame_numbers(scene).items() if "frame" in ob]
    return (min(numbers), max(numbers)) if numbers else None


def _frame_numbers(scene: bpy.types.Scene) -> dict[bpy.types.Object, int]:
    """Return the timeline frames of our cameras."""
    return {ob: number for root in lifts_in(scene) for ob, number in places_of(root, scene).items()}
