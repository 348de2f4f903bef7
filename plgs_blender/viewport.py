"""What editors show: the first look of a file that we start, 3D views that show a lift, a picture in an image editor.

Files of the user's keep their looks.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

from .cameras import OVERVIEW_SIZE
from .compat import composite_without_gpu, use_nodes


def start_file() -> bpy.types.Scene:
    """Begin an empty file in metres. A lift is unlit, so Cycles is set to few rays."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.unit_settings.system, scene.unit_settings.length_unit = "METRIC", "METERS"
    scene.view_settings.view_transform = "Standard"
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.max_bounces = 16, False, 0
    scene.render.resolution_x, scene.render.resolution_y = OVERVIEW_SIZE
    composite_without_gpu(scene)
    show_object_colours(scene.display.shading)
    scene.world = bpy.data.worlds.new("World")
    set_ground(scene.world)
    return scene


def set_ground(world: bpy.types.World) -> None:
    """Give the world a dark, neutral ground on which all colours stand out."""
    background = next(node for node in use_nodes(world).nodes if node.bl_idname == "ShaderNodeBackground")
    background.inputs["Color"].default_value = (0.016, 0.018, 0.022, 1.0)


def show_object_colours(shading: Any) -> None:
    """Let Solid shading show clouds in the colour of their class and boxes in that of their instance."""
    # Flat: on a million little balls, light and shadow are nothing but noise.
    shading.light, shading.color_type = "FLAT", "OBJECT"
    shading.show_cavity = shading.show_shadows = shading.show_object_outline = False


def show_lift_colours(view: bpy.types.SpaceView3D) -> None:
    """Let a 3D view show the colours of classes and instances in Solid shading, and boxes in coloured lines."""
    show_object_colours(view.shading)
    view.shading.type = "SOLID"
    view.shading.wireframe_color_type = "OBJECT"


def show_lift_colours_at_first(view: bpy.types.SpaceView3D) -> None:
    """`show_lift_colours` in a view that is still as Blender starts it, where a lift would be nothing but grey. Other
    views keep their looks.
    """
    if view.shading.type == "SOLID" and view.shading.color_type == "MATERIAL" and view.shading.light == "STUDIO":
        show_lift_colours(view)


def show_lift_colours_in(scene: bpy.types.Scene) -> None:
    """The same in all 3D views of windows that show this scene."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas if window.scene == scene else ():
            if area.type == "VIEW_3D":
                show_lift_colours_at_first(area.spaces.active)


def view_of(context: bpy.types.Context) -> tuple[bpy.types.SpaceView3D | None, float]:
    """The 3D view that somebody works in, else the largest of the screen, else None; and its width by its height."""
    areas = [area for area in context.screen.areas if area.type == "VIEW_3D"] if context.screen is not None else []
    if context.area is not None and context.area.type == "VIEW_3D":
        areas = [context.area]
    if not areas:
        return None, 1.0
    area = max(areas, key=lambda each: each.width * each.height)
    region = next((region for region in area.regions if region.type == "WINDOW"), None)
    aspect = region.width / region.height if region is not None and region.width and region.height else 1.0
    return area.spaces.active, aspect


def look_from(scene: bpy.types.Scene, camera: bpy.types.Object, target: Vector) -> None:
    """Let every 3D view of the file look at `target` from where the camera stands, in object colours."""
    rotation = camera.matrix_world.to_quaternion()
    distance = (camera.matrix_world.translation - target).length
    for screen in bpy.data.screens:
        for area in screen.areas:
            for space in area.spaces:
                if space.type != "VIEW_3D":
                    continue
                show_lift_colours(space)
                space.overlay.show_relationship_lines = False
                space.clip_start = 0.01
                view = space.region_3d
                view.view_perspective = "PERSP"
                view.view_location, view.view_rotation, view.view_distance = target, rotation, distance


def show_finding(picture: Path, screens: Iterable[bpy.types.Screen]) -> tuple[bpy.types.Image, bool]:
    """Load the picture of a finding in place of an earlier one of that name, and show it in the largest image editor.
    Returns the image, and whether there is such an editor. The image is packed, because the next diagnosis deletes its
    file. Raises OSError when the file is gone.
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
    editors = [area for screen in screens for area in screen.areas if area.type == "IMAGE_EDITOR"]
    if editors:
        max(editors, key=lambda area: area.width * area.height).spaces.active.image = image
    return image, bool(editors)
