"""What an import or a result changes in a startup file that nobody has touched: there the view becomes the capture's.

A scene in which somebody has set or made anything keeps its range, size, camera and objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np
from mathutils import Vector

from .cameras import pixel_aspect
from .compat import show_stored_colours
from .lift_collection import lifts_in
from .owned import KEY, LIFT
from .timeline import places_of

_PLACES = {
    "MESH": (0.0, 0.0, 0.0),
    "CAMERA": (7.35889, -6.92579, 4.95831),
    "LIGHT": (4.07625, 1.00545, 5.90386),
}
"""Where Blender's startup file has its cube, camera and light, metres."""
_RANGE, _SIZE, _ASPECT = (1, 250), (1920, 1080, 100), (1.0, 1.0)


@contextmanager
def taking_over(scene: bpy.types.Scene) -> Iterator[bool]:
    """While a capture or a lift is placed: gives whether the scene is an untouched startup scene. If it is, it then
    has the capture's range, size, pixel aspect, camera and colours, and its own objects are hidden. A range that
    already was that of our frames follows them. When placing fails, all is as before.
    """
    is_untouched = _is_untouched(scene)
    follows = is_untouched or _range(scene) == _span(scene)
    camera = scene.camera
    if is_untouched:
        scene.camera = None  # else our markers would lie behind its range, and leave it the camera
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
        show_stored_colours(scene)  # those of the photos
    scene.frame_start, scene.frame_end = span
    places = _places(scene)
    overview = next((place for ob, place in places.items() if "frame" not in ob), span[0])
    place = overview if is_untouched else places.get(camera, span[0])
    if (scene.frame_current, scene.camera) != (place, camera):  # else Blender would evaluate all for nothing
        scene.frame_set(place)


def _is_untouched(scene: bpy.types.Scene) -> bool:
    """Whether a scene is as Blender's startup file has it, with its three objects or without some of them."""
    render = scene.render
    size = (render.resolution_x, render.resolution_y, render.resolution_percentage)
    aspect = (render.pixel_aspect_x, render.pixel_aspect_y)
    has_defaults = (_range(scene), size, aspect) == (_RANGE, _SIZE, _ASPECT) and not scene.timeline_markers
    is_new = not bpy.data.filepath and KEY not in scene and has_defaults
    return is_new and all(LIFT in ob or _is_startup_object(ob) for ob in scene.objects)  # a live preview is ours


def _is_startup_object(ob: bpy.types.Object) -> bool:
    place = _PLACES.get(ob.type)
    if place is None or ob.animation_data is not None or len(ob.modifiers) or len(ob.constraints):
        return False
    is_there = (ob.location - Vector(place)).length < 1e-3 and ob.scale == Vector((1.0, 1.0, 1.0))
    return is_there and (ob.type != "MESH" or _is_cube(ob.data))


def _is_cube(mesh: bpy.types.Mesh) -> bool:
    """Whether a mesh is the cube of two metres that Blender starts with."""
    xyz = np.array([vertex.co for vertex in mesh.vertices]).reshape(-1, 3)
    return len(xyz) == 8 and bool((np.abs(xyz) == 1.0).all())


def _hide_startup_objects(scene: bpy.types.Scene) -> None:
    """Hide what is not ours, in the views and, where it is in the way there too, in renders."""
    for ob in scene.objects:
        if LIFT in ob:
            continue
        ob.hide_render = ob.hide_render or ob.type == "MESH"
        for layer in scene.view_layers:
            if ob.name in layer.objects:
                ob.hide_set(True, view_layer=layer)
                if layer.objects.active == ob:
                    layer.objects.active = None  # else all editors speak of a cube that nobody sees


def _use_size(scene: bpy.types.Scene) -> None:
    """Take size and pixel aspect of the first frame."""
    places = _places(scene)
    frame = next((ob for ob in sorted(places, key=places.__getitem__) if "frame" in ob), None)
    if frame is not None:
        render = scene.render
        render.resolution_x, render.resolution_y = frame["width"], frame["height"]
        render.pixel_aspect_x, render.pixel_aspect_y = pixel_aspect(frame["fx"], frame["fy"])


def _range(scene: bpy.types.Scene) -> tuple[int, int]:
    return scene.frame_start, scene.frame_end


def _span(scene: bpy.types.Scene) -> tuple[int, int] | None:
    """The first and the last place of our cameras on the timeline; None without any."""
    places = _places(scene).values()
    return (min(places), max(places)) if places else None


def _places(scene: bpy.types.Scene) -> dict[bpy.types.Object, int]:
    """The places of our cameras on the timeline."""
    return {ob: place for root in lifts_in(scene) for ob, place in places_of(root, scene).items()}
