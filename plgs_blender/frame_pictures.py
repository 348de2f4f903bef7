"""A frame's photo, depth or masks in front of its camera's view, on demand.

Blender's Python decodes neither depth nor masks: an engine draws them as image files.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import bpy

from ..engine.errors import PlgsError
from ..engine.job import LiftFolder
from ..engine.posed.made_frames import MadeFrame
from .chosen_scene import ChosenScene
from .frames import PHOTO, SHOWN, put_before, show_photo
from .lift_collection import FOLDER, PLACE, SCENE, lifts_in
from .owned import LIFT, OwnedDataBlocks
from .paths import absolute

DEPTH, MASKS = "DEPTH", "MASKS"
KIND_OF = {DEPTH: "depth", MASKS: "masks", PHOTO: "colour"}
"""The engine's names of the pictures."""

_NEAR, _FAR = "near_metres", "far_metres"
"""Properties of a picture of depth: the metres that its lightest and its darkest colour mean."""


def why_no_picture(scene: bpy.types.Scene) -> str | None:
    """Why nothing can be shown in front of the active camera; None when something can. Never reads the disk."""
    ob = scene.camera
    if ob is None or "frame" not in ob or LIFT not in ob:
        return "Look through a frame's camera first: select it and press Ctrl+Numpad 0"
    return None


def root_of(scene: bpy.types.Scene, ob: bpy.types.Object) -> bpy.types.Collection:
    """The collection of the import or lift that a frame's camera belongs to. Raises PlgsError."""
    root = next((each for each in lifts_in(scene) if each[LIFT] == ob.get(LIFT)), None)
    if root is None:
        raise PlgsError("does not belong to any scene that is here", ob.name, "Import the scene again.")
    return root


def place_of_root(root: bpy.types.Collection) -> ChosenScene:
    """The scene that the frames of an import or a lift come from. Raises PlgsError when its lift folder is gone."""
    if root.get(FOLDER):
        request = LiftFolder.open(absolute(root[FOLDER])).request
        return ChosenScene(**{each.name: getattr(request, each.name) for each in fields(ChosenScene)})
    return ChosenScene.of(root[SCENE], **root.get(PLACE, {}))


def has_picture(made: MadeFrame, what: str) -> bool:
    """Whether an engine made the photo, depth or masks of a frame, and the file is still there."""
    path = _file_of(made, what)
    return path is not None and path.is_file()


def _file_of(made: MadeFrame, what: str) -> Path | None:
    return {PHOTO: made.colour, DEPTH: made.depth, MASKS: made.masks}[what]


def show_made(scene: bpy.types.Scene, ob: bpy.types.Object, what: str, made: MadeFrame) -> None:
    """Show what an engine made of the camera's frame. Raises PlgsError when it made none."""
    path = _file_of(made, what)
    if path is None or not has_picture(made, what):
        raise PlgsError(f"has no {KIND_OF[what]}", ob["frame"], "Import the scene again.")
    owned = OwnedDataBlocks(root_of(scene, ob)[LIFT], scene)
    if what == PHOTO:
        show_photo(ob, owned, path)
    else:
        image = bpy.data.images.load(str(path), check_existing=False)
        image.name = _name(what, ob["frame"])
        _show(ob, owned, what, image, made.depth_range if what == DEPTH else None)


def range_shown(ob: bpy.types.Object) -> tuple[float, float] | None:
    """The metres that the lightest and darkest colour of the depth in front of a camera mean; None without depth."""
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
