"""Draw overlays of the 3D views: the live preview, the cameras' path, outlines, the cutting plane, names and a legend.

Views are drawn many times a second, so everything comes from Blender's data: no disk access, no writing."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ..plgs_blender import correction_tools
from ..plgs_blender.cameras import SHOWN
from ..plgs_blender.frame_pictures import MASKS, colour_numbers, colours_shown
from ..plgs_blender.inspecting import drawing, highlight, picking
from ..plgs_blender.inspecting.looks import BY_CLASS, POINTS, SURENESS, SURFACE, UNCERTAINTY, lifts_shown
from ..plgs_blender.inspecting.picking import camera_of, names_to_draw, outline_of, outlined
from ..plgs_blender.inspecting.selection import CUT, objects_by_key, selected_instance
from ..plgs_blender.owned import lifts_in
from ..plgs_blender.running import lifts
from ..plgs_blender.running.survey import survey_of_panel
from ..plgs_blender.viewport import own_view

_CUT_COLOUR = (1.0, 0.55, 0.1, 0.25)
_handles: list[Any] = []


def _is_wanted(context: bpy.types.Context) -> bool:
    """Whether this is a 3D view with its overlays on."""
    view = context.space_data
    return view is not None and view.type == "VIEW_3D" and view.overlay.show_overlays


def _draw_in_space() -> None:
    """Draw in the scene's space, where nearer things hide it (POST_VIEW): the cameras' path and the cutting plane."""
    context = bpy.context
    for root in lifts_in(context.scene) if _is_wanted(context) else ():
        objects = objects_by_key(root)
        _draw_cameras_path(context, root, objects)
        cut = objects.get(CUT)
        if cut is not None and cut.visible_in_viewport_get(context.space_data):
            drawing.draw_face([cut.matrix_world @ vertex.co for vertex in cut.data.vertices], _CUT_COLOUR)


def _draw_cameras_path(
    context: bpy.types.Context, root: bpy.types.Collection, objects: dict[str, bpy.types.Object]
) -> None:
    """Draw the path of visible frame cameras (`objects` by key), unless it is off or the view is a camera's."""
    is_off = len(root.plgs.classes) > 0 and not root.plgs.show_cameras
    if is_off or context.region_data.view_perspective == "CAMERA":
        return
    frames = [ob for key, ob in objects.items() if key.startswith("frame:")]
    seen = [ob for ob in frames if ob.visible_in_viewport_get(context.space_data)]
    drawing.draw_path([ob.matrix_world.translation for ob in seen])


def _draw_on_top() -> None:
    """Draw in the region's pixels, on top of everything (POST_PIXEL)."""
    context = bpy.context
    if not _is_wanted(context):
        return
    _draw_preview(context)
    for each in correction_tools.now:
        each.draw(context.region_data, _size(context))
    region = drawing.ViewRegion.of(context)
    for root in lifts_shown(context.scene, context.view_layer):
        row = outlined(context, root)
        for corners in outline_of(context, row, region) if row is not None else ():
            drawing.draw_outline(corners, tuple(row.colour))
        if row is None:
            _draw_selected(context, root)
        drawing.draw_text_boxes(drawing.legend_text_boxes(legend_of(context, root), region))
        drawing.draw_text_boxes(names_to_draw(context, root, region))


def _draw_selected(context: bpy.types.Context, root: bpy.types.Collection) -> None:
    """Draw the outline of the selected instance, unless it is isolated."""
    lists = root.plgs
    number = selected_instance(root, context.view_layer.objects.active)
    row = next((row for row in lists.instances if row.instance_id == number), None)
    if row is None or not lists.show_selected or lists.isolated:
        return

    def is_outlined(cloud: bpy.types.Object) -> bool:
        # Hidden points lie on the visible surface or splats, so the outline is computed from them.
        is_stand_in = lists.show_as != POINTS and "class_id" in cloud
        return is_stand_in or cloud.visible_in_viewport_get(context.space_data)

    mesh = objects_by_key(root).get(f"mesh:{row.class_id}:{number}") if lists.show_as == SURFACE else None
    if mesh is not None and mesh.visible_in_viewport_get(context.space_data):
        seen = highlight.highlight_of_mesh(root, mesh)
    else:
        seen = highlight.highlight_of(root, number, is_outlined)
    colour = drawing.brightened(tuple(row.colour))
    drawing.draw_mark(highlight.mark_of(seen, context.region_data, _size(context), colour))


def legend_of(context: bpy.types.Context, root: bpy.types.Collection) -> list[tuple[str, drawing.Colour | None]]:
    """Return the names and colours (None: no colour) of the live preview, else of the masks shown, else of the lift."""
    camera, lists = camera_of(context), root.plgs
    if camera is not None and camera == context.scene.camera:
        if lifts.picture_for(context.scene) is not None:
            return [("Objects: each in its own colour", None), *classes_of_scene(context.scene, stuff_only=True)]
        if camera.get(SHOWN) == MASKS:
            seen, classes = colours_shown(camera), classes_of_scene(context.scene)
            numbers = colour_numbers(np.array([colour for _, colour in classes]).reshape(-1, 3)).tolist()
            return [each for each, number in zip(classes, numbers, strict=True) if seen is None or number in seen]
    if lists.show_legend or (lists.look == BY_CLASS and len(lists.classes)):
        return [*drawing.shown_classes(lists.classes)]
    return [*SURENESS] if lists.look == UNCERTAINTY and len(lists.classes) else []


def classes_of_scene(scene: bpy.types.Scene, *, stuff_only: bool = False) -> tuple[tuple[str, drawing.Colour], ...]:
    """Return the classes of the panel's scene with their colours, as far as known; with ``stuff_only``, no things."""
    survey = survey_of_panel(scene.plgs)
    classes = survey.classes if survey is not None else ()
    return tuple(each for each in classes if not stuff_only or (survey is not None and each[0] not in survey.things))


def _draw_preview(context: bpy.types.Context) -> None:
    """Draw the live preview over the frame of the scene's camera if the view looks through it, else over the view."""
    scene, own = context.scene, own_view(context.scene)
    picture, camera = lifts.picture_for(scene), camera_of(context)
    if picture is None:
        return
    if own is not None and own[0] == context.area:
        drawing.draw_picture(picture, [(0, 0), _size(context)], blend="ALPHA")
    elif camera is not None and camera == scene.camera:
        at, turned, _ = camera.matrix_world.decompose()  # a camera's scale does not change what it sees
        frame = [at + turned @ corner for corner in camera.data.view_frame(scene=scene)]
        region = drawing.ViewRegion.of(context)
        drawing.draw_picture(picture, [region.pixel_of(corner) for corner in frame], blend="ALPHA")


def _size(context: bpy.types.Context) -> tuple[int, int]:
    return context.region.width, context.region.height


def register() -> None:
    add = bpy.types.SpaceView3D.draw_handler_add
    _handles.append(add(_draw_in_space, (), "WINDOW", "POST_VIEW"))
    _handles.append(add(_draw_on_top, (), "WINDOW", "POST_PIXEL"))


def unregister() -> None:
    while _handles:
        bpy.types.SpaceView3D.draw_handler_remove(_handles.pop(), "WINDOW")
    highlight.forget()
    drawing.uploaded.clear()
    correction_tools.now.clear()
    picking.forget()
