"""What editors show: the first look of a file that we start, 3D views that show a lift, a picture in an image editor.

The user's own files keep their look.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Quaternion, Vector
from numpy.typing import NDArray

from .cameras import OVERVIEW_SIZE
from .compat import composite_without_gpu, show_stored_colours, use_nodes

_VIEW_SENSOR = 72.0
"""Width of a 3D view's sensor in millimetres: twice that of a camera."""
_LEFT_TO_VIEW = 0.6
"""Share of a 3D view's width that it keeps when a picture is shown beside it."""
_FILLED = 0.92
"""Share of the free part of a view that the room fills."""
_SAME = 1e-3
"""Radians, and shares of its distance, by which a view may differ from where it was put."""


def start_file() -> bpy.types.Scene:
    """Begin an empty file in metres. A lift is unlit, so Cycles is set to few rays."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.unit_settings.system, scene.unit_settings.length_unit = "METRIC", "METERS"
    show_stored_colours(scene)
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.max_bounces = 16, False, 0
    scene.render.resolution_x, scene.render.resolution_y = OVERVIEW_SIZE
    composite_without_gpu(scene)
    show_object_colours(scene.display.shading)
    scene.world = bpy.data.worlds.new("World")
    set_ground(scene.world)
    for area in all_views():
        for space in area.spaces:
            if space.type == "VIEW_3D":
                show_materials(space, always=True)
    return scene


def all_views() -> list[bpy.types.Area]:
    """The 3D views of the file, in all its workspaces."""
    return [area for screen in bpy.data.screens for area in screen.areas if area.type == "VIEW_3D"]


def set_ground(world: bpy.types.World) -> None:
    """Give the world a dark, neutral background on which all colours stand out."""
    background = next(node for node in use_nodes(world).nodes if node.bl_idname == "ShaderNodeBackground")
    background.inputs["Color"].default_value = (0.016, 0.018, 0.022, 1.0)


def show_object_colours(shading: Any) -> None:
    """Let Solid shading show clouds in the colour of their class and boxes in that of their instance."""
    # Flat: on a million little balls, light and shadow are nothing but noise.
    shading.light, shading.color_type, shading.show_backface_culling = "FLAT", "OBJECT", False
    shading.show_cavity = shading.show_shadows = shading.show_object_outline = False


def show_lift_colours(view: bpy.types.SpaceView3D) -> None:
    """Let a 3D view show a lift's colours in Solid shading, as a user asked: the attribute Col of splats and meshes,
    with their backs open, points in their classes' colours, as they have no others there, and boxes in coloured lines.
    """
    view.shading.type = "SOLID"
    show_object_colours(view.shading)
    view.shading.color_type, view.shading.show_backface_culling = "VERTEX", True
    view.shading.wireframe_color_type = "OBJECT"


def show_materials(view: bpy.types.SpaceView3D, *, always: bool = False) -> None:
    """Let a 3D view that is as Blender starts it, or ``always``, show materials: our unlit ones have the photos'
    colours, and other objects look as they always do there; and boxes in coloured lines. Views that somebody has set
    keep their look, also those that were once here.
    """
    shading = view.shading
    is_as_started = shading.type == "SOLID" and shading.color_type == "MATERIAL" and shading.light == "STUDIO"
    if always or (is_as_started and shading.wireframe_color_type == "THEME"):
        shading.type, shading.show_backface_culling, shading.wireframe_color_type = "MATERIAL", True, "OBJECT"
        view.clip_start = 0.01
        view.overlay.show_relationship_lines = view.overlay.show_floor = False


def show_materials_in(scene: bpy.types.Scene) -> None:
    """The same in all 3D views of windows that show this scene."""
    for area in areas_of(scene):
        show_materials(area.spaces.active)


def show_room(areas: Iterable[bpy.types.Area], rotation: Quaternion, corners: NDArray[np.float64]) -> None:
    """Let these 3D views look at the room with these corners [N, 3], in metres, turned as a camera with this rotation
    is, in the part that the sidebar leaves free. Views through a camera stay.
    """
    for area in areas:
        space = area.spaces.active
        show_materials(space)
        if space.region_3d.view_perspective != "CAMERA":
            frame_room(area, rotation, corners)


def areas_that_show(
    scene: bpy.types.Scene, rotation: Quaternion, corners: NDArray[np.float64]
) -> list[bpy.types.Area]:
    """The 3D views that stand where `show_room` puts them with this rotation and these corners [N, 3]: nobody has
    moved them since.
    """
    return [area for area in areas_of(scene) if _stands(area.spaces.active.region_3d, *_place(area, rotation, corners))]


def _stands(view: bpy.types.RegionView3D, rotation: Quaternion, location: Vector, distance: float) -> bool:
    turned = view.view_rotation.rotation_difference(rotation).angle % (2.0 * math.pi)
    is_turned = min(turned, 2.0 * math.pi - turned) > _SAME
    is_away = max((view.view_location - location).length, abs(view.view_distance - distance)) > _SAME * distance
    return view.view_perspective == "PERSP" and not (is_turned or is_away)


def areas_of(scene: bpy.types.Scene) -> list[bpy.types.Area]:
    """The 3D views of the windows with this scene."""
    windows = [window for window in bpy.context.window_manager.windows if window.scene == scene]
    return [area for window in windows for area in window.screen.areas if area.type == "VIEW_3D"]


def show_gizmos(scene: bpy.types.Scene, shown: bool) -> bool:
    """Let the 3D views of the windows with this scene show, or not, the arrows and rings that move the active object.
    Whether that changed any view."""
    spaces = [area.spaces.active for area in areas_of(scene)]
    changed = [space for space in spaces if space.show_gizmo_object_translate != shown]
    for space in changed:
        space.show_gizmo_object_translate = space.show_gizmo_object_rotate = shown
    return bool(changed)


def frame_room(area: bpy.types.Area, rotation: Quaternion, corners: NDArray[np.float64]) -> None:
    """Let a 3D view, turned so, hold all corners [N, 3] in what the sidebar leaves free."""
    view = area.spaces.active.region_3d
    view.view_perspective = "PERSP"
    view.view_rotation, view.view_location, view.view_distance = _place(area, rotation, corners)


def _place(
    area: bpy.types.Area, rotation: Quaternion, corners: NDArray[np.float64]
) -> tuple[Quaternion, Vector, float]:
    """Rotation, location and distance of a 3D view that holds all corners in what the sidebar leaves free."""
    space = area.spaces.active
    window, covered = _free_of_sidebar(area)
    axes = np.array(rotation.to_matrix())  # columns: right, up, towards the eye
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
    local = (corners - middle) @ axes
    width, height = _FILLED * np.array([window.width, window.height]) / max(window.width, window.height)
    # A corner at (x, y) and z nearer than the location is seen at (x, y) / (distance - z), from -low to high.
    low = np.array([width, height]) * _VIEW_SENSOR / 2.0 / space.lens
    high = low * [1.0 - 2.0 * covered, 1.0]
    most = (local[:, :2] + high * local[:, 2:]).max(axis=0)
    least = (local[:, :2] - low * local[:, 2:]).min(axis=0)
    distance = float(((most - least) / (low + high)).max())
    aside = (most - high * distance + least + low * distance) / 2.0
    return rotation, Vector((middle + axes[:, :2] @ aside).tolist()), distance


def _free_of_sidebar(area: bpy.types.Area) -> tuple[bpy.types.Region, float]:
    """A 3D view's main region, and the share of its width, at the right, that the sidebar covers."""
    window = next(region for region in area.regions if region.type == "WINDOW")
    bar = next((region for region in area.regions if region.type == "UI"), None)
    covered = bar.width / window.width if bar is not None and bar.width > 1 and bar.x >= window.x else 0.0
    return window, covered if covered < 0.6 else 0.0


def look_through(space: bpy.types.SpaceView3D, scene: bpy.types.Scene) -> None:
    """Let a 3D view look through its camera. Where its frame is as Blender puts it, half as wide as the view and partly
    behind the sidebar, it fills what the bars at its sides leave free.
    """
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
    # Blender's own scales: its frame is (sqrt(2) + zoom / 50)^2 / 4 of the longest side, and moves by so many of these.
    view.view_camera_zoom = max(-30.0, 50.0 * (2.0 * math.sqrt(share) - math.sqrt(2.0)))
    view.view_camera_offset = ((covered - left) * window.width / longest / (4.0 * max(share, 1e-3)), 0.0)


def view_of(context: bpy.types.Context) -> tuple[bpy.types.SpaceView3D | None, float]:
    """The 3D view that the user works in, else the largest of the screen, else None; and its width by its height."""
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
    """Load the picture of a finding in place of an earlier one of that name. The image is packed, because the next
    diagnosis deletes its file. Raises OSError when the file is gone.
    """
    if not picture.is_file():
        raise OSError(f"the picture is gone, diagnose again: {picture}")
    image = bpy.data.images.load(str(picture), check_existing=False)
    image.pack()
    name = f"PLGS finding {picture.stem}"
    earlier = bpy.data.images.get(name)
    if earlier is not None:
        earlier.user_remap(image)
        bpy.data.images.remove(earlier)
    image.name = name
    return image


def show_beside(image: bpy.types.Image, context: bpy.types.Context) -> bool:
    """Show an image in the largest image editor, or else in one that is split off the largest 3D view. Returns whether
    there is either."""
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
