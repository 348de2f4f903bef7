"""Overlays of the 3D views: the growing model in front of the camera, the path of the frames' cameras, the outline of
the selected instance or of a mask, the cutting plane, painted points, names and a legend.

Each view is drawn many times a second, so everything comes from Blender's data: no disk access, no writing.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ..plgs_blender import correction_tools
from ..plgs_blender.cameras import SHOWN
from ..plgs_blender.correction_tools import CUT
from ..plgs_blender.frame_pictures import MASKS, colour_numbers, colours_shown
from ..plgs_blender.inspecting import highlight, picking
from ..plgs_blender.inspecting.drawing import (
    Colour,
    ViewRegion,
    brightened,
    draw_face,
    draw_mark,
    draw_outline,
    draw_path,
    draw_picture,
    draw_text_boxes,
    forget_pictures,
    legend_text_boxes,
    shown_classes,
)
from ..plgs_blender.inspecting.looks import BY_CLASS, POINTS, SURENESS, UNCERTAINTY
from ..plgs_blender.inspecting.picking import camera_of, names_to_draw, outline_of, outlined
from ..plgs_blender.inspecting.selection import objects_by_key, selected_instance
from ..plgs_blender.owned import lifts_in
from ..plgs_blender.running import lifts
from ..plgs_blender.running.survey import survey_of_panel
from ..plgs_blender.viewport import own_view

_CUT_COLOUR = (1.0, 0.55, 0.1, 0.25)
_OBJECTS = "Objects: each in its own colour"

_handles: list[Any] = []


def _is_wanted(context: bpy.types.Context) -> bool:
    """Whether this is a 3D view with its overlays on."""
    view = context.space_data
    return view is not None and view.type == "VIEW_3D" and view.overlay.show_overlays


def _lifts(context: bpy.types.Context) -> list[bpy.types.Collection]:
    """The lifts to draw for; none if the view's overlays are off."""
    return lifts_in(context.scene) if _is_wanted(context) else []


def _draw_in_space() -> None:
    """POST_VIEW: in the scene's space, hidden by nearer things."""
    context = bpy.context
    for root in _lifts(context):
        objects = objects_by_key(root)
        _draw_cameras_path(context, root, objects)
        cut = objects.get(CUT)
        if cut is not None and cut.visible_in_viewport_get(context.space_data):
            draw_face([cut.matrix_world @ vertex.co for vertex in cut.data.vertices], _CUT_COLOUR)


def _draw_cameras_path(
    context: bpy.types.Context, root: bpy.types.Collection, objects: dict[str, bpy.types.Object]
) -> None:
    """Draw the path of the visible frames' cameras, unless the view looks through a camera or the lift's path is
    off."""
    is_off = len(root.plgs.classes) > 0 and not root.plgs.show_cameras
    if is_off or context.region_data.view_perspective == "CAMERA":
        return
    frames = [ob for key, ob in objects.items() if key.startswith("frame:")]
    seen = [ob for ob in frames if ob.visible_in_viewport_get(context.space_data)]
    draw_path([ob.matrix_world.translation for ob in seen])


def _draw_on_top() -> None:
    """POST_PIXEL: in the region's pixels, on top of everything."""
    context = bpy.context
    if not _is_wanted(context):
        return
    _draw_preview(context)
    for each in correction_tools.now:
        each.draw(context.region_data, _size(context))
    region = ViewRegion.of(context)
    for root in _lifts(context):
        row = outlined(context, root)
        for corners in outline_of(context, row, region) if row is not None else ():
            draw_outline(corners, tuple(row.colour))
        if row is None:
            _draw_selected(context, root)
        draw_text_boxes(legend_text_boxes(legend_of(context, root), region))
        draw_text_boxes(names_to_draw(context, root, region))


def _draw_selected(context: bpy.types.Context, root: bpy.types.Collection) -> None:
    """Draw the outline of the selected instance, unless it is isolated."""
    lists = root.plgs
    number = selected_instance(root, context.view_layer.objects.active)
    row = next((row for row in lists.instances if row.instance_id == number), None)
    if row is None or not lists.show_selected or lists.isolated:
        return
    # The points lie on the surface and among the splats, so they have the outline of these too.
    seen = highlight.highlight_of(
        root,
        number,
        lambda cloud: (
            (lists.show_as != POINTS and "class_id" in cloud) or cloud.visible_in_viewport_get(context.space_data)
        ),
    )
    draw_mark(highlight.mark_of(seen, context.region_data, _size(context), brightened(tuple(row.colour))))


def legend_of(context: bpy.types.Context, root: bpy.types.Collection) -> list[tuple[str, Colour | None]]:
    """The legend of the view's colours: those of a live preview or of masks in front of the camera, else of the lift;
    empty if they mean nothing."""
    camera, lists = camera_of(context), root.plgs
    if camera is not None and camera == context.scene.camera:
        if lifts.picture_for(context.scene) is not None:
            stuff = classes_of_scene(context.scene, stuff_only=True)
            return [(_OBJECTS, None), *stuff]
        if camera.get(SHOWN) == MASKS:
            seen, classes = colours_shown(camera), classes_of_scene(context.scene)
            numbers = colour_numbers(np.array([colour for _, colour in classes]).reshape(-1, 3)).tolist()
            return [each for each, number in zip(classes, numbers, strict=True) if seen is None or number in seen]
    if lists.show_legend or (lists.look == BY_CLASS and len(lists.classes)):
        return [*shown_classes(lists.classes)]
    return [*SURENESS] if lists.look == UNCERTAINTY and len(lists.classes) else []


def classes_of_scene(scene: bpy.types.Scene, *, stuff_only: bool = False) -> tuple[tuple[str, Colour], ...]:
    """The classes of the panel's scene, as far as they are known."""
    survey = survey_of_panel(scene.plgs)
    classes = survey.classes if survey is not None else ()
    return tuple(each for each in classes if not stuff_only or (survey is not None and each[0] not in survey.things))


def _draw_preview(context: bpy.types.Context) -> None:
    """Draw the live preview over the frame of the scene's camera if the view looks through it, else over the whole
    view."""
    space, scene = context.space_data, context.scene
    own = own_view(scene)
    if own is not None and own[0] == context.area and (picture := lifts.picture_for(scene)) is not None:
        width, height = _size(context)
        draw_picture(picture, [(width, height), (width, 0), (0, 0), (0, height)])
        return
    looks = space.camera if space.use_local_camera else scene.camera
    if context.region_data.view_perspective != "CAMERA" or looks != scene.camera:
        return
    picture = lifts.picture_for(scene)
    if picture is not None:
        at, turned, _ = looks.matrix_world.decompose()
        frame = [at + turned @ corner for corner in looks.data.view_frame(scene=scene)]
        region = ViewRegion.of(context)
        draw_picture(picture, [region.pixel_of(corner) for corner in frame])


def _size(context: bpy.types.Context) -> tuple[int, int]:
    return context.region.width, context.region.height


CLASSES = ()


def register() -> None:
    add = bpy.types.SpaceView3D.draw_handler_add
    _handles.append(add(_draw_in_space, (), "WINDOW", "POST_VIEW"))
    _handles.append(add(_draw_on_top, (), "WINDOW", "POST_PIXEL"))


def unregister() -> None:
    while _handles:
        bpy.types.SpaceView3D.draw_handler_remove(_handles.pop(), "WINDOW")
    highlight.forget()
    forget_pictures()
    correction_tools.now.clear()
    picking.forget()
