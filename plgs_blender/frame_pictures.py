"""A frame's photo, depth or masks before what its camera sees, on demand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.job import JobError, LiftFolder
from ..engine.job.made_frames import MadeFrame
from ..engine.scene import Frame, Scene
from ..engine.scene.frame_colours import depth_colours, mask_colours
from .decoding import read_here
from .frames import PHOTO, SHOWN, picture_of, put_before, show_photo
from .lift_collection import FOLDER, PLACE, SCENE, lifts_in
from .owned import LIFT, OwnedDataBlocks
from .paths import absolute
from .scene_formats import AUTOMATIC
from .scene_survey import Place

DEPTH, MASKS = "DEPTH", "MASKS"
KIND_OF = {DEPTH: "depth", MASKS: "masks", PHOTO: "colour"}
"""What the engine calls it."""

NEAR, FAR = "near_metres", "far_metres"
"""Properties of a picture of depth: what its lightest and its darkest colour mean."""


def why_no_picture(scene: bpy.types.Scene) -> str | None:
    """Why nothing can be shown before the active camera; None when it can. Looks at no disk."""
    ob = scene.camera
    if ob is None or "frame" not in ob or LIFT not in ob:
        return "Look through a frame's camera first: select it and press Ctrl+Numpad 0"
    return None


def root_of(scene: bpy.types.Scene, ob: bpy.types.Object) -> bpy.types.Collection:
    """The collection of the import or lift that a frame's camera belongs to. Raises JobError."""
    root = next((each for each in lifts_in(scene) if each[LIFT] == ob.get(LIFT)), None)
    if root is None:
        raise JobError("belongs to no scene that is here", ob.name, "Import the scene again.")
    return root


def place_of_root(root: bpy.types.Collection) -> Place:
    """Where the frames of an import or a lift come from. Raises JobError when its lift folder is gone."""
    if root.get(FOLDER):
        request = LiftFolder.open(absolute(root[FOLDER])).request
        return Place(
            request.scene, request.masks, request.up, request.scene_format, request.depth, request.mask_format,
            request.classes,
        )  # fmt: skip
    asked = root.get(PLACE, {})
    masks, up = asked.get("masks", ""), asked.get("up", "z")
    return Place.of(
        root[SCENE], masks, up, asked.get("format", AUTOMATIC), asked.get("depth", ""),
        asked.get("mask_format", AUTOMATIC), asked.get("classes", ""),
    )  # fmt: skip


def frame_of(opened: Scene, ob: bpy.types.Object) -> Frame:
    """The frame that a camera shows. Raises JobError when the scene does not have it any more."""
    frame = next((each for each in opened.frames if each.name == ob["frame"]), None)
    if frame is None:
        raise JobError("is no frame of the scene any more", ob["frame"], "Import the scene again.")
    return frame


def show_here(scene: bpy.types.Scene, ob: bpy.types.Object, what: str, made: MadeFrame | None) -> bool:
    """Show a frame's photo, depth or masks before its camera's view, without an engine; False where that takes one.
    `made` is what an engine made of the frame before. Raises JobError when the frame has none, SceneError.
    """
    root = root_of(scene, ob)
    owned = OwnedDataBlocks(root[LIFT], scene)
    opened = place_of_root(root).open()
    frame = frame_of(opened, ob)
    if what == PHOTO:
        colour = {} if made is None or made.colour is None else {frame.name: made.colour}
        picture = picture_of(frame, colour)
        if picture is None:
            return False
        show_photo(ob, owned, picture)
        return True
    if what == DEPTH:
        if frame.read_depth is None:
            raise JobError("has no depth", frame.name, "Give a folder of depth maps, and import the scene again.")
        depth = read_here(frame.read_depth)
        if depth is None:
            return False
        drawn = depth_colours(depth)
        _show(ob, owned, what, _new_image(drawn.rgb, _name(what, frame.name)), (drawn.near, drawn.far))
        return True
    if frame.read_mask is None:
        raise JobError("has no mask", frame.name, "Give masks in the panel, and import the scene again.")
    mask = read_here(frame.read_mask)
    if mask is None:
        return False
    _show(ob, owned, what, _new_image(mask_colours(mask, opened.classes), _name(what, frame.name)))
    return True


def show_made(scene: bpy.types.Scene, ob: bpy.types.Object, what: str, made: MadeFrame) -> None:
    """Show what an engine made of the camera's frame. Raises JobError when it made none."""
    path = {PHOTO: made.colour, DEPTH: made.depth, MASKS: made.masks}[what]
    if path is None or not path.is_file():
        raise JobError(f"has no {KIND_OF[what]}", ob["frame"], "Import the scene again.")
    owned = OwnedDataBlocks(root_of(scene, ob)[LIFT], scene)
    if what == PHOTO:
        show_photo(ob, owned, path)
    else:
        _show(ob, owned, what, _load(path, _name(what, ob["frame"])), made.depth_range if what == DEPTH else None)


def range_shown(ob: bpy.types.Object) -> tuple[float, float] | None:
    """The metres that the lightest and the darkest colour of the depth before a camera mean; None without depth."""
    if ob.get(SHOWN) != DEPTH or not ob.data.background_images:
        return None
    image = ob.data.background_images[0].image
    return None if image is None or NEAR not in image else (image[NEAR], image[FAR])


def _show(
    ob: bpy.types.Object,
    owned: OwnedDataBlocks,
    what: str,
    image: bpy.types.Image,
    span: tuple[float, float] | None = None,
) -> None:
    key = f"{KIND_OF[what]}:{ob['frame']}"
    owned.drop("images", key)
    owned.block("images", key, lambda: image)
    if span is not None:
        image[NEAR], image[FAR] = span
    put_before(ob, image, what, 1.0)


def _name(what: str, frame: str) -> str:
    return f"{KIND_OF[what].capitalize()} {frame}"


def _new_image(rgb: NDArray[Any], name: str) -> bpy.types.Image:
    """An image that is kept in the .blend, of uint8 [H, W, 3] sRGB."""
    height, width, _ = rgb.shape
    image = bpy.data.images.new(name, width, height, alpha=False)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = rgb[::-1] / np.float32(255.0)  # Blender's first row is the lowest
    image.pixels.foreach_set(rgba.ravel())
    image.pack()
    return image


def _load(path: Path, name: str) -> bpy.types.Image:
    image = bpy.data.images.load(str(path), check_existing=False)
    image.name = name
    return image
