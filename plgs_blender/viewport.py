"""What editors show: a file that we create, 3D views of a lift, and a picture. Views that a user set up keep theirs."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy
import gpu
import numpy as np
from mathutils import Matrix, Quaternion, Vector
from numpy.typing import NDArray

from ..engine.posed.frames import Camera
from .cameras import OVERVIEW_SIZE
from .compat import composite_without_gpu, show_stored_colours, use_nodes
from .owned import lifts_in

VIEW_SENSOR = 72.0
"""Sensor width of a 3D view in millimetres: twice that of a camera."""
_LEFT_TO_VIEW = 0.6  # fraction of a 3D view's width that is left when a picture opens beside it
_FILLED = 0.92  # fraction of a view's free part that the room fills
_SAME = 1e-3  # radians, and fractions of its distance, by which a view that the user has not moved may differ


def start_file() -> bpy.types.Scene:
    """Start an empty file whose unit is metres, and return its scene."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.unit_settings.system, scene.unit_settings.length_unit = "METRIC", "METERS"
    show_stored_colours(scene)
    scene.render.engine = "CYCLES"
    # A lift is unlit, so Cycles needs few rays.
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.max_bounces = 16, False, 0
    scene.render.resolution_x, scene.render.resolution_y = OVERVIEW_SIZE
    composite_without_gpu(scene)
    show_object_colours(scene.display.shading)
    scene.world = bpy.data.worlds.new("World")
    background = next(node for node in use_nodes(scene.world).nodes if node.bl_idname == "ShaderNodeBackground")
    background.inputs["Color"].default_value = (0.016, 0.018, 0.022, 1.0)  # dark and neutral: all colours stand out
    for area in all_views():
        for space in area.spaces:
            if space.type == "VIEW_3D":
                show_lift_colours(space)  # it may be opened where there is no graphics card
                space.clip_start, space.show_region_ui = 0.01, True
                space.overlay.show_relationship_lines = space.overlay.show_floor = False
    return scene


def all_views() -> list[bpy.types.Area]:
    """Return the 3D views of the file, in all its workspaces."""
    return [area for screen in bpy.data.screens for area in screen.areas if area.type == "VIEW_3D"]


def show_object_colours(shading: Any) -> None:
    """Make Solid shading show clouds in their class's colour and boxes in their instance's."""
    # On a million little balls, light and shadow would be noise.
    shading.light, shading.color_type, shading.show_backface_culling = "FLAT", "OBJECT", False
    shading.show_cavity = shading.show_shadows = shading.show_object_outline = False


def show_lift_colours(view: bpy.types.SpaceView3D) -> None:
    """Show a lift's colours in a 3D view's Solid shading: splats and meshes by their attribute Col, with open backs;
    points by class, as Solid shading has only one colour for them; and boxes as coloured lines."""
    view.shading.type = "SOLID"
    show_object_colours(view.shading)
    view.shading.color_type, view.shading.show_backface_culling = "VERTEX", True
    view.shading.wireframe_color_type = "OBJECT"


NEW = "plgs_new"
"""Property of a lift's collection in a file that we made and nobody has looked at yet."""
_TRIES, _TRY_S = 60, 0.2
_tries: list[int] = []


def look_first() -> float | None:
    """Show the sidebar's tab PLGS when a file that PLGS made is opened for the first time, and materials if there is a
    graphics card. As a timer, it returns the seconds to wait until Blender has drawn the tab; then None."""
    new = [root for scene in bpy.data.scenes for root in lifts_in(scene) if root.get(NEW)]
    bars = [region for area in all_views() for region in area.regions if region.type == "UI" and region.width > 1]
    _tries.append(0)
    if not new or len(_tries) > _TRIES:
        _tries.clear()
        return None
    shown = []
    for bar in bars:
        with suppress(AttributeError, TypeError):  # not drawn yet
            bar.active_panel_category = "PLGS"
            shown.append(bar)
    if not shown:
        return _TRY_S
    for area in all_views() if not draws_in_software() else ():
        show_materials(area.spaces.active, always=True)
    for root in new:
        del root[NEW]
    _tries.clear()
    return None


def draws_in_software() -> bool:
    """Whether the CPU draws because there is no graphics card. Material Preview then takes a minute to start."""
    try:
        return str(gpu.platform.device_type_get()) == "SOFTWARE"
    except SystemError:  # Blender has no window
        return False


def show_materials(view: bpy.types.SpaceView3D, *, always: bool = False) -> None:
    """Make a 3D view show our unlit materials, which have the photos' colours, and boxes in coloured lines; without a
    graphics card, in Solid shading. Unless ``always``, views that the user has set up keep their look."""
    shading = view.shading
    is_as_started = shading.type == "SOLID" and shading.color_type == "MATERIAL" and shading.light == "STUDIO"
    if always or (is_as_started and shading.wireframe_color_type == "THEME"):
        if draws_in_software() and not always:
            show_lift_colours(view)
        else:
            shading.type, shading.show_backface_culling, shading.wireframe_color_type = "MATERIAL", True, "OBJECT"
        view.clip_start = 0.01
        view.overlay.show_relationship_lines = view.overlay.show_floor = False


def show_materials_in(scene: bpy.types.Scene) -> None:
    """Show materials, as `show_materials` does, in all 3D views of windows that show this scene."""
    for area in areas_of(scene):
        show_materials(area.spaces.active)


def show_room(areas: Iterable[bpy.types.Area], rotation: Quaternion, corners: NDArray[np.float64]) -> None:
    """Point these 3D views, except those through a camera, at a room with corners [N, 3] in metres."""
    for area in areas:
        space = area.spaces.active
        show_materials(space)
        if space.region_3d.view_perspective != "CAMERA":
            frame_room(area, rotation, corners)


def areas_that_show(scene: bpy.types.Scene, rotation: Quaternion, corners: NDArray[np.float64]) -> list[bpy.types.Area]:
    """Return the 3D views that are still where `show_room` puts them with this rotation and these corners [N, 3]."""
    found = []
    for area in areas_of(scene):
        view, (_, location, distance) = area.spaces.active.region_3d, _pose(area, rotation, corners)
        turned = view.view_rotation.rotation_difference(rotation).angle % (2.0 * math.pi)
        moved = max((view.view_location - location).length, abs(view.view_distance - distance)) / distance
        if view.view_perspective == "PERSP" and max(min(turned, 2.0 * math.pi - turned), moved) <= _SAME:
            found.append(area)
    return found


def areas_of(scene: bpy.types.Scene) -> list[bpy.types.Area]:
    """Return the 3D views of the windows with this scene."""
    windows = [window for window in bpy.context.window_manager.windows if window.scene == scene]
    return [area for window in windows for area in window.screen.areas if area.type == "VIEW_3D"]


def own_view(scene: bpy.types.Scene) -> tuple[bpy.types.Area, Camera] | None:
    """Return the scene's first 3D view, if in perspective, and what it sees; None if any looks through a camera."""
    areas = [area for area in areas_of(scene) if _free_of_sidebar(area)[0].width > 1]
    if not areas or any(area.spaces.active.region_3d.view_perspective == "CAMERA" for area in areas):
        return None
    space, window = areas[0].spaces.active, _free_of_sidebar(areas[0])[0]
    view, focal = space.region_3d, max(window.width, window.height) * space.lens / VIEW_SENSOR
    if view.view_perspective != "PERSP":
        return None
    eye = view.view_location + view.view_rotation @ Vector((0.0, 0.0, view.view_distance))
    pose = np.array(Matrix.LocRotScale(eye, view.view_rotation, None)) @ np.diag((1.0, -1.0, -1.0, 1.0))  # OpenCV's
    middle = window.width / 2.0, window.height / 2.0
    return areas[0], Camera(window.width, window.height, focal, focal, *middle, pose)


def show_gizmos(scene: bpy.types.Scene, shown: bool) -> bool:
    """Show or hide the gizmos that move the active object in the scene's 3D views. Returns whether any view changed."""
    spaces = [area.spaces.active for area in areas_of(scene)]
    changed = [space for space in spaces if space.show_gizmo_object_translate != shown]
    for space in changed:
        space.show_gizmo_object_translate = space.show_gizmo_object_rotate = shown
    return bool(changed)


def frame_room(area: bpy.types.Area, rotation: Quaternion, corners: NDArray[np.float64]) -> None:
    """Fit all corners [N, 3] into the part of a 3D view that the sidebar leaves free, with this rotation."""
    view = area.spaces.active.region_3d
    view.view_perspective = "PERSP"
    view.view_rotation, view.view_location, view.view_distance = _pose(area, rotation, corners)


def _pose(area: bpy.types.Area, rotation: Quaternion, corners: NDArray[np.float64]) -> tuple[Quaternion, Vector, float]:
    """Return rotation, location and distance with which a 3D view shows all corners [N, 3] beside the sidebar."""
    space = area.spaces.active
    window, covered = _free_of_sidebar(area)
    axes = np.array(rotation.to_matrix())  # columns: right, up, towards the eye
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
    local = (corners - middle) @ axes
    width, height = _FILLED * np.array([window.width, window.height]) / max(window.width, window.height)
    # A corner at (x, y) and z nearer than the location is seen at (x, y) / (distance - z), from -low to high.
    low = np.array([width, height]) * VIEW_SENSOR / 2.0 / space.lens
    high = low * [1.0 - 2.0 * covered, 1.0]
    most = (local[:, :2] + high * local[:, 2:]).max(axis=0)
    least = (local[:, :2] - low * local[:, 2:]).min(axis=0)
    distance = float(((most - least) / (low + high)).max())
    aside = (most - high * distance + least + low * distance) / 2.0
    return rotation, Vector((middle + axes[:, :2] @ aside).tolist()), distance


def _free_of_sidebar(area: bpy.types.Area) -> tuple[bpy.types.Region, float]:
    """Return a 3D view's main region, and the fraction of its width that the sidebar covers at the right."""
    window = next(region for region in area.regions if region.type == "WINDOW")
    bar = next((region for region in area.regions if region.type == "UI"), None)
    covered = bar.width / window.width if bar is not None and bar.width > 1 and bar.x >= window.x else 0.0
    return window, covered if covered < 0.6 else 0.0


def look_through(space: bpy.types.SpaceView3D, scene: bpy.types.Scene) -> None:
    """Make a 3D view look through its camera. Unless the user has moved the camera's frame, it fills the part of the
    view that the side bars leave free; Blender's own is half as wide, and partly behind the sidebar."""
    view = space.region_3d
    view.view_perspective = "CAMERA"
    area = next((each for each in all_views() if each.spaces.active == space), None)
    if area is None or view.view_camera_zoom != 0.0 or any(view.view_camera_offset):
        return
    window, covered = _free_of_sidebar(area)
    tools = next((region for region in area.regions if region.type == "TOOLS"), None)
    left = tools.width / window.width if tools is not None and tools.width > 1 and tools.x >= window.x else 0.0
    render = scene.render
    sides = np.array([render.resolution_x * render.pixel_aspect_x, render.resolution_y * render.pixel_aspect_y])
    room = _FILLED * np.array([window.width * (1.0 - covered - left), window.height])
    longest = max(window.width, window.height, 1)
    share = float((room / (sides / sides.max())).min()) / longest
    # Blender's frame takes (sqrt(2) + zoom / 50)^2 / 4 of the longest side; the offset counts in such frames.
    view.view_camera_zoom = max(-30.0, 50.0 * (2.0 * math.sqrt(share) - math.sqrt(2.0)))
    view.view_camera_offset = ((covered - left) * window.width / longest / (4.0 * max(share, 1e-3)), 0.0)


def view_of(context: bpy.types.Context) -> tuple[bpy.types.SpaceView3D | None, float]:
    """Return the 3D view that the user works in, else the screen's largest, else None; and its width / height."""
    areas = [area for area in context.screen.areas if area.type == "VIEW_3D"] if context.screen is not None else []
    if context.area is not None and context.area.type == "VIEW_3D":
        areas = [context.area]
    if not areas:
        return None, 1.0
    area = max(areas, key=lambda each: each.width * each.height)
    region = next((region for region in area.regions if region.type == "WINDOW"), None)
    aspect = region.width / region.height if region is not None and region.width and region.height else 1.0
    return area.spaces.active, aspect


def load_finding(picture: Path) -> bpy.types.Image:
    """Load a finding's picture, which replaces the one loaded before. Raises OSError if its file is gone."""
    if not picture.is_file():
        raise OSError(f"the finding's picture was deleted, diagnose again: {picture}")
    image = bpy.data.images.load(str(picture), check_existing=False)
    image.pack()  # the next diagnosis deletes the file
    name = f"PLGS finding {picture.stem}"
    earlier = bpy.data.images.get(name)
    if earlier is not None:
        earlier.user_remap(image)
        bpy.data.images.remove(earlier)
    image.name = name
    return image


def show_beside(image: bpy.types.Image, context: bpy.types.Context) -> bool:
    """Show an image in the largest image editor, else in one split off the largest 3D view. Returns if it is shown."""
    areas = [(window, area) for window in context.window_manager.windows for area in window.screen.areas]
    editors = _largest_first(areas, "IMAGE_EDITOR")
    if not editors and (views := _largest_first(areas, "VIEW_3D")):
        window, view = views[0]
        with context.temp_override(window=window, area=view):
            bpy.ops.screen.area_split(direction="VERTICAL", factor=_LEFT_TO_VIEW)
        known = {area for _, area in areas}
        editors = [(window, area) for area in window.screen.areas if area not in known]
        for _, area in editors:
            area.type = "IMAGE_EDITOR"
    for window, area in editors[:1]:
        area.spaces.active.image = image
        region = next(each for each in area.regions if each.type == "WINDOW")
        with context.temp_override(window=window, area=area, region=region):
            bpy.ops.image.view_all(fit_view=True)
        area.tag_redraw()
    return bool(editors)


def _largest_first(
    areas: Iterable[tuple[bpy.types.Window, bpy.types.Area]], kind: str
) -> list[tuple[bpy.types.Window, bpy.types.Area]]:
    found = [(window, area) for window, area in areas if area.type == kind]
    return sorted(found, key=lambda each: -each[1].width * each[1].height)
