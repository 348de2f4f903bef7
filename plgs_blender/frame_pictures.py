"""A frame's photo, depth or masks before what its camera sees, on demand.

Blender's Python has no OpenCV, so image files are decoded by Blender itself. What takes more is left to an engine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.errors import PlgsError
from ..engine.job import LiftFolder
from ..engine.job.made_frames import MadeFrame
from ..engine.scene import Frame, Scene, Size
from ..engine.scene.frame_colours import depth_colours, mask_colours
from ..engine.scene.image_header import read_image_header
from ..engine.scene.pixels import decoding_with
from .chosen_scene import ChosenScene
from .frames import PHOTO, SHOWN, picture_of, put_before, show_photo
from .lift_collection import FOLDER, PLACE, SCENE, lifts_in
from .owned import LIFT, OwnedDataBlocks
from .paths import absolute

DEPTH, MASKS = "DEPTH", "MASKS"
KIND_OF = {DEPTH: "depth", MASKS: "masks", PHOTO: "colour"}
"""The engine's names of the pictures."""

_NEAR, _FAR = "near_metres", "far_metres"
"""Properties of a picture of depth: the metres that its lightest and its darkest colour mean."""

_Pixels = TypeVar("_Pixels")


def why_no_picture(scene: bpy.types.Scene) -> str | None:
    """Why nothing can be shown before the active camera; None when something can. Reads no disk."""
    ob = scene.camera
    if ob is None or "frame" not in ob or LIFT not in ob:
        return "Look through a frame's camera first: select it and press Ctrl+Numpad 0"
    return None


def root_of(scene: bpy.types.Scene, ob: bpy.types.Object) -> bpy.types.Collection:
    """The collection of the import or lift that a frame's camera belongs to. Raises PlgsError."""
    root = next((each for each in lifts_in(scene) if each[LIFT] == ob.get(LIFT)), None)
    if root is None:
        raise PlgsError("belongs to no scene that is here", ob.name, "Import the scene again.")
    return root


def place_of_root(root: bpy.types.Collection) -> ChosenScene:
    """The scene that the frames of an import or a lift come from. Raises PlgsError when its lift folder is gone."""
    if root.get(FOLDER):
        request = LiftFolder.open(absolute(root[FOLDER])).request
        return ChosenScene(**{each.name: getattr(request, each.name) for each in fields(ChosenScene)})
    return ChosenScene.of(root[SCENE], **root.get(PLACE, {}))


def _frame_of(opened: Scene, ob: bpy.types.Object) -> Frame:
    """The frame of a camera. Raises PlgsError when the scene has it no more."""
    frame = next((each for each in opened.frames if each.name == ob["frame"]), None)
    if frame is None:
        raise PlgsError("is no frame of the scene any more", ob["frame"], "Import the scene again.")
    return frame


def show_here(scene: bpy.types.Scene, ob: bpy.types.Object, what: str, made: MadeFrame | None) -> bool:
    """Show a frame's photo, depth or masks before its camera's view. False where that takes an engine. `made` is what
    an engine made of the frame before. Raises PlgsError, also when the frame has none.
    """
    root = root_of(scene, ob)
    owned = OwnedDataBlocks(root[LIFT], scene)
    opened = place_of_root(root).open()
    frame = _frame_of(opened, ob)
    if what == PHOTO:
        picture = picture_of(frame, {frame.name: made.colour} if made is not None and made.colour is not None else {})
        if picture is not None:
            show_photo(ob, owned, picture)
        return picture is not None
    if what == DEPTH:
        if frame.read_depth is None:
            raise PlgsError("has no depth", frame.name, "Give a folder of depth maps, and import the scene again.")
        depth = read_here(frame.read_depth)
        if depth is None:
            return False
        drawn = depth_colours(depth)
        _show(ob, owned, what, _new_image(drawn.rgb, _name(what, frame.name)), (drawn.near, drawn.far))
        return True
    if frame.read_mask is None:
        raise PlgsError("has no mask", frame.name, "Give masks in the panel, and import the scene again.")
    mask = read_here(frame.read_mask)
    if mask is not None:
        _show(ob, owned, what, _new_image(mask_colours(mask, opened.classes), _name(what, frame.name)))
    return mask is not None


def show_made(scene: bpy.types.Scene, ob: bpy.types.Object, what: str, made: MadeFrame) -> None:
    """Show what an engine made of the camera's frame. Raises PlgsError when it made none."""
    path = {PHOTO: made.colour, DEPTH: made.depth, MASKS: made.masks}[what]
    if path is None or not path.is_file():
        raise PlgsError(f"has no {KIND_OF[what]}", ob["frame"], "Import the scene again.")
    owned = OwnedDataBlocks(root_of(scene, ob)[LIFT], scene)
    if what == PHOTO:
        show_photo(ob, owned, path)
    else:
        image = bpy.data.images.load(str(path), check_existing=False)
        image.name = _name(what, ob["frame"])
        _show(ob, owned, what, image, made.depth_range if what == DEPTH else None)


def range_shown(ob: bpy.types.Object) -> tuple[float, float] | None:
    """The metres that the lightest and the darkest colour of the depth before a camera mean; None without depth."""
    if ob.get(SHOWN) != DEPTH or not ob.data.background_images:
        return None
    image = ob.data.background_images[0].image
    return None if image is None or _NEAR not in image else (image[_NEAR], image[_FAR])


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
        image[_NEAR], image[_FAR] = span
    put_before(ob, image, what, 1.0)


def _name(what: str, frame: str) -> str:
    return f"{KIND_OF[what].capitalize()} {frame}"


def _new_image(rgb: NDArray[Any], name: str) -> bpy.types.Image:
    """An image of uint8 [H, W, 3] sRGB that is kept in the .blend."""
    height, width, _ = rgb.shape
    image = bpy.data.images.new(name, width, height, alpha=False)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = rgb[::-1] / np.float32(255.0)  # Blender's first row is the lowest
    image.pixels.foreach_set(rgba.ravel())
    image.pack()
    return image


def read_here(read: Callable[[Size | None], _Pixels]) -> _Pixels | None:
    """What a frame's reader returns, with images decoded by Blender. None where the reader needs another package:
    OpenCV for videos and curved lenses, or h5py. Raises PlgsError.
    """
    with decoding_with(decode_in_blender):
        try:
            return read(None)
        except ImportError:
            return None


def decode_in_blender(path: Path, as_colour: bool) -> NDArray[Any]:
    """`engine.scene.pixels.decode` by Blender: the same numbers for PNGs of 8 and 16 bits and for 8-bit JPEGs. Raises
    PlgsError.
    """
    header = read_image_header(path)
    image = bpy.data.images.load(str(path), check_existing=False)
    try:
        # As data: neither converted to linear light nor multiplied by alpha.
        image.colorspace_settings.is_data, image.alpha_mode = True, "CHANNEL_PACKED"
        width, height = image.size
        if (width, height) != header.size:
            raise PlgsError("the image cannot be decoded", path, "Write this file again.")
        values = np.empty(width * height * image.channels, np.float32)
        image.pixels.foreach_get(values)
        deep = image.is_float
    finally:
        bpy.data.images.remove(image)
    pixels = values.reshape(height, width, -1)[::-1]  # Blender's first row is the lowest
    whole = np.rint(pixels * (65535.0 if deep else 255.0)).astype(np.uint16 if deep else np.uint8)
    if as_colour:
        colour = (whole >> 8).astype(np.uint8) if deep else whole
        return np.ascontiguousarray(colour[..., :3])
    if header.channels <= 2 and not header.palette:
        return np.ascontiguousarray(whole[..., 0])
    return np.ascontiguousarray(whole[..., : max(3, header.channels)])
