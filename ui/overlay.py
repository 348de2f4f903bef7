"""What is drawn over the 3D views: the growing model in front of the camera, the path of the frames' cameras, the
selected instance's points, the outline of a mask, what is painted, labels and a legend.

Each view is drawn many times a second, so everything is read from Blender's data: no disk access, no writing.
"""

from __future__ import annotations

from typing import Any

import bpy

from ..plgs_blender import painting
from ..plgs_blender.frame_pictures import MASKS
from ..plgs_blender.frames import SHOWN
from ..plgs_blender.inspecting import highlight
from ..plgs_blender.inspecting.drawing import (
    draw_highlight,
    draw_outline,
    draw_path,
    draw_picture,
    draw_text_boxes,
    forget_picture,
)
from ..plgs_blender.inspecting.looks import POINTS
from ..plgs_blender.inspecting.lookup import boxes_of, objects_by_key
from ..plgs_blender.inspecting.selection import selected_instance
from ..plgs_blender.inspecting.text_boxes import Colour, ViewRegion, label_text_boxes, legend_text_boxes, shown_classes
from ..plgs_blender.lift_collection import lifts_in
from ..plgs_blender.running import live_preview
from ..plgs_blender.running.survey import survey_of
from ..plgs_blender.settings import chosen_scene

_handles: list[Any] = []


def _is_wanted(context: bpy.types.Context) -> bool:
    """Whether this is a 3D view with its overlays on."""
    view = context.space_data
    return view is not None and view.type == "VIEW_3D" and view.overlay.show_overlays


def _lifts(context: bpy.types.Context) -> list[bpy.types.Collection]:
    """The lifts to draw for; none while the view's overlays are off."""
    return lifts_in(context.scene) if _is_wanted(context) else []


def _draw_in_space() -> None:
    """POST_VIEW: in the scene's space, behind what is nearer."""
    context = bpy.context
    for each in painting.now if _is_wanted(context) else ():
        each.draw(context.region_data, _size(context))
    for root in _lifts(context):
        _draw_cameras_path(context, root)
        lists = root.plgs
        number = selected_instance(root, context.view_layer.objects.active)
        row = next((row for row in lists.instances if row.instance_id == number), None)
        if row is None or not lists.show_selected:
            continue
        # A mask's outline shows more than points do, and leaves the photo visible.
        is_outlined = row == _outlined(context, root)
        # The points lie on the surface and among the splats, so they mark these too.
        seen = highlight.NOTHING if is_outlined else highlight.highlight_of(
            root,
            number,
            lambda cloud, lists=lists: (lists.show_as != POINTS and "class_id" in cloud)
            or cloud.visible_in_viewport_get(context.space_data),
        )
        box, dim = boxes_of(root).get(number), lists.dim_others and not is_outlined
        draw_highlight(context.region_data, _size(context), seen, box, tuple(row.colour), dim)


def _draw_cameras_path(context: bpy.types.Context, root: bpy.types.Collection) -> None:
    """Draw the path of the visible frames' cameras, unless the view looks through a camera."""
    if context.region_data.view_perspective == "CAMERA":
        return
    frames = [ob for key, ob in objects_by_key(root).items() if key.startswith("frame:")]
    seen = [ob for ob in frames if ob.visible_in_viewport_get(context.space_data)]
    draw_path([ob.matrix_world.translation for ob in seen])


def _draw_on_top() -> None:
    """POST_PIXEL: in pixels of the region, over everything."""
    context = bpy.context
    if _is_wanted(context):
        _draw_preview(context)
        for each in painting.now:
            each.draw_brush()
    for root in _lifts(context):
        lists = root.plgs
        region = ViewRegion.of(context)
        _draw_mask(context, root, region)
        if lists.show_legend:
            draw_text_boxes(legend_text_boxes(shown_classes(lists.classes), region))
        elif shows_classes(context):
            draw_text_boxes(legend_text_boxes(classes_of_scene(context.scene), region))
        if lists.show_labels:
            boxes = {
                number: box
                for number, box in boxes_of(root).items()
                if box.visible_in_viewport_get(context.space_data)
            }
            active = selected_instance(root, context.view_layer.objects.active)
            draw_text_boxes(label_text_boxes(lists.instances, boxes, active, region))


def shows_classes(context: bpy.types.Context) -> bool:
    """Whether the view looks at masks, or at the live preview, through the scene's camera."""
    camera = context.scene.camera
    if camera is None or context.region_data.view_perspective != "CAMERA":
        return False
    return camera.get(SHOWN) == MASKS or live_preview.picture_for(context.scene) is not None


def classes_of_scene(scene: bpy.types.Scene) -> tuple[tuple[str, Colour], ...]:
    """The classes of the scene that the panel shows, as far as they are known."""
    survey = survey_of(chosen_scene(scene.plgs)) if scene.plgs.scene_folder else None
    return survey.classes if survey is not None else ()


def _draw_preview(context: bpy.types.Context) -> None:
    """Draw the live preview over the frame of the scene's camera while the view looks through it."""
    space, scene = context.space_data, context.scene
    looks = space.camera if space.use_local_camera else scene.camera
    if context.region_data.view_perspective != "CAMERA" or looks != scene.camera:
        return
    picture = live_preview.picture_for(scene)
    if picture is not None:
        at, turned, _ = looks.matrix_world.decompose()
        frame = [at + turned @ corner for corner in looks.data.view_frame(scene=scene)]
        region = ViewRegion.of(context)
        draw_picture(picture, [region.pixel_of(corner) for corner in frame])


def _draw_mask(context: bpy.types.Context, root: bpy.types.Collection, region: ViewRegion) -> None:
    """Draw the outline of the chosen mask while the view looks through the camera of its frame."""
    camera, row = context.scene.camera, _outlined(context, root)
    if camera is None or row is None:
        return
    mask = row.masks[row.mask_index]
    for polygon in highlight.outline_in_space(camera, mask.outline, tuple(mask.rectangle)):
        corners = [region.pixel_of(corner) for corner in polygon]
        if None not in corners:
            draw_outline([corner for corner in corners if corner is not None], tuple(row.colour))


def _outlined(context: bpy.types.Context, root: bpy.types.Collection) -> Any:
    """The chosen instance's row, if the view looks through the camera of its chosen mask's frame."""
    lists, camera = root.plgs, context.scene.camera
    if context.region_data.view_perspective != "CAMERA" or not 0 <= lists.instance_index < len(lists.instances):
        return None
    row = lists.instances[lists.instance_index]
    if camera is None or not 0 <= row.mask_index < len(row.masks):
        return None
    mask = row.masks[row.mask_index]
    is_here = objects_by_key(root).get(f"frame:{mask.frame}") == camera and mask.rectangle[2] > 0.0
    return row if is_here else None


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
    forget_picture()
    painting.now.clear()
