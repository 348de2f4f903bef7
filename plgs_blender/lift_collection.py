"""The collection of a lift in a scene, "PLGS <scene>", which is found again by what it was made from; its children."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import bpy

from ..engine.errors import PlgsError
from .owned import KEY, LIFT, key_of, tag, text_of
from .paths import absolute

FOLDER, SCENE = "plgs_lift_folder", "plgs_scene_folder"
"""Properties of a lift's collection: the folder of the lift, and that of the scene it was made from. The first is empty
while the scene is only imported."""

PLACE = "plgs_place"
"""Property of an imported scene's collection: how the scene was read (masks, up, format, depth), as texts."""

GAUSSIANS = "gaussians"
"""The key of the object with a lift's splats."""
_ROOT = "lift"


def lifts_in(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """The collections of the lifts that were placed in a scene."""
    return [c for c in scene.collection.children_recursive if text_of(c, LIFT) and text_of(c, KEY) == _ROOT]


def lift_of_scene(scene_folder: Path, scene: bpy.types.Scene) -> Path | None:
    """The folder of the lift of `scene_folder` that is placed in a scene; None when none is."""
    for root in lifts_in(scene):
        if root.get(FOLDER) and is_same_place(root.get(SCENE, ""), scene_folder):
            return Path(bpy.path.abspath(root[FOLDER])).resolve()
    return None


def folder_of(root: bpy.types.Collection) -> Path:
    """The folder of a placed lift."""
    return absolute(text_of(root, FOLDER))


def overview_of(root: bpy.types.Collection) -> bpy.types.Object | None:
    """A lift's overview camera, None when the user removed it."""
    return next((ob for ob in root.all_objects if key_of(ob, root[LIFT]) == "overview"), None)


def is_placed(lift: Path, scene: bpy.types.Scene) -> bool:
    """Whether the lift's result is in `scene`."""
    return any(is_same_place(text_of(root, FOLDER), lift) for root in lifts_in(scene_to_fill(scene)))


def root_of_placed(lift: Path, scene: bpy.types.Scene) -> bpy.types.Collection:
    """The collection of the lift that is placed in `scene`. Raises PlgsError."""
    for root in lifts_in(scene_to_fill(scene)):
        if is_same_place(text_of(root, FOLDER), lift):
            return root
    raise PlgsError("is not in this scene", lift, "Show the lift's result first.")


@dataclass(frozen=True)
class Placed:
    """Where a lift was placed, in words that stay valid after undo and after opening another file."""

    lift: str
    scene: str

    def find(self) -> tuple[bpy.types.Collection, bpy.types.Scene] | None:
        """The lift's collection and its scene; None when one of them is gone."""
        scene = bpy.data.scenes.get(self.scene)
        for root in lifts_in(scene) if scene is not None else ():
            if root[LIFT] == self.lift:
                return root, scene
        return None


def root_collection(scene_folder: Path, lift_folder: Path | None, scene: bpy.types.Scene) -> bpy.types.Collection:
    """The collection of this lift or of an earlier one of the same scene, or a new one.

    Raises PlgsError, before anything is changed, when Blender cannot name one of the folders.
    """
    _check_name(scene_folder)
    if lift_folder is not None:
        _check_name(lift_folder)
    for root in lifts_in(scene):
        is_same_lift = lift_folder is not None and is_same_place(text_of(root, FOLDER), lift_folder)
        is_ours = root.library is None and root.override_library is None
        if is_ours and (is_same_lift or is_same_place(text_of(root, SCENE), scene_folder)):
            break
    else:
        root = bpy.data.collections.new("PLGS")
        tag(root, uuid4().hex, _ROOT)
        root[FOLDER] = ""
        scene.collection.children.link(root)
    root.name = f"PLGS {scene_folder.name}"
    root[SCENE] = str(scene_folder.absolute())
    if lift_folder is not None:
        root[FOLDER] = str(lift_folder)
    return root


def scene_to_fill(scene: bpy.types.Scene) -> bpy.types.Scene:
    """The scene with the lift when `scene` holds a lift's passes, else `scene` itself. Raises PlgsError when the lift's
    scene is gone.
    """
    if KEY not in scene:
        return scene
    for other in bpy.data.scenes:
        if KEY not in other and any(root[LIFT] == scene.get(LIFT) for root in lifts_in(other)):
            return other
    raise PlgsError("is only for the passes of a lift", scene.name, "Switch to a scene of your own.")


def _check_name(folder: Path) -> None:
    """Raises PlgsError when Blender cannot keep the path: it knows UTF-8 only, and takes backslashes for slashes."""
    path = str(folder.absolute())
    is_text = path.isascii() or path.encode(errors="ignore") == os.fsencode(path)
    if not is_text or (os.sep == "/" and "\\" in path):
        what = "has a name that Blender cannot open"
        shown = path.encode(errors="backslashreplace").decode()
        raise PlgsError(what, shown, "Rename it: letters of any script, but no backslash and no broken characters.")


def is_same_place(stored: str, folder: Path) -> bool:
    """Whether a path as it is stored in a .blend means this folder. The stored path is not looked up on the disk: it
    may come from somebody else, and lie on a disk that never answers.
    """
    return bool(stored) and _normal(bpy.path.abspath(stored)) in (_normal(folder), _normal(folder.resolve()))


def _normal(path: str | Path) -> str:
    return os.path.normcase(os.path.abspath(path))


def child_collection(
    root: bpy.types.Collection, name: str, scene: bpy.types.Scene | None = None, hidden: bool = False
) -> bpy.types.Collection:
    """Our collection `name` under the root. One made `hidden` starts with its eye and camera off in the scene."""
    key = f"collection:{name}"
    for child in root.children:
        if key_of(child, root[LIFT]) == key:
            return child
    child = bpy.data.collections.new(name)
    tag(child, root[LIFT], key)
    root.children.link(child)
    if hidden and scene is not None:
        child.hide_render = True
        for view_layer in scene.view_layers:
            if view_layer.layer_collection is None:  # Blender 5 makes it when the scene is shown for the first time
                view_layer.update()
            for found in _layer_collections(view_layer.layer_collection):
                if found.collection == child:
                    found.hide_viewport = True
    return child


def is_child(child: bpy.types.Collection, root: bpy.types.Collection, name: str) -> bool:
    """Whether a collection is the one that `child_collection` made of this name."""
    return key_of(child, root[LIFT]) == f"collection:{name}"


def _layer_collections(top: bpy.types.LayerCollection) -> list[bpy.types.LayerCollection]:
    return [top, *(found for child in top.children for found in _layer_collections(child))]
