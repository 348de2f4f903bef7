"""Identify our data-blocks, and the collection "PLGS <scene>" that holds those of a lift.

Each block that we make has two custom properties: its lift and its key there ("frame:0012", "instance:3"). Names are
only for users, who may change them. When a lift is placed again, the blocks are found by these properties and refilled,
so that references to them (the active camera, a constraint, a marker) stay valid. `sweep` removes those that the new
result no longer has. Blocks without our properties are never touched."""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import bpy

from ..engine.errors import PlgsError
from .chosen_scene import absolute
from .results import version_of

LIFT = "plgs_lift"
KEY = "plgs_key"

_OBJECT_TYPE = {"Camera": "CAMERA", "PointCloud": "POINTCLOUD", "Mesh": "MESH"}

# Each kind comes before the kinds that it uses: an image has no user only when its camera is gone.
_DATA = ("cameras", "pointclouds", "meshes", "materials", "node_groups", "images", "actions")


def tag(block: Any, lift: str, key: str) -> None:
    """Mark a data-block or node as ours: store its `lift` and `key` in custom properties."""
    block[LIFT], block[KEY] = lift, key


def untag(block: Any) -> None:
    """Remove our mark from a block, which then belongs to the user."""
    for name in (LIFT, KEY):
        if name in block:
            del block[name]


def key_of(block: Any, lift: str) -> str | None:
    """Return a block's key in this lift; None if it is not the lift's or is linked from another file."""
    if getattr(block, "library", None) is not None or text_of(block, LIFT) != lift:
        return None
    return text_of(block, KEY) or None


def text_of(block: Any, name: str) -> str:
    """Return a custom property; "" if it is missing or not text."""
    value = block.get(name)
    return value if isinstance(value, str) else ""


def numbers_of(block: Any, name: str) -> list[float]:
    """Return a custom property's numbers; [] if it is missing or not a list of numbers."""
    value = block.get(name)
    return [*value] if getattr(value, "typecode", "") == "d" else []  # Blender's arrays of doubles


def originals(objects: Iterable[bpy.types.Object], lift: str) -> dict[str, bpy.types.Object]:
    """Return the lift's objects by key. Duplicates, which have the same properties, are the user's and left out."""
    found: dict[str, bpy.types.Object] = {}
    for ob in objects:
        key = text_of(ob, KEY)
        if key and text_of(ob, LIFT) == lift:
            known = found.setdefault(key, ob)
            if known != ob and _age(ob) < _age(known):
                found[key] = ob
    return found


def _age(ob: bpy.types.Object) -> tuple[bool, int, int, bool, int]:
    """A rank that is smaller for an original than for its duplicates, even after loading renumbered `session_uid`."""
    is_astray = not any(LIFT in collection for collection in ob.users_collection)
    data = _copy_number(ob.data.name) if ob.data is not None else 0
    return ob.library is not None, data, _copy_number(ob.name), is_astray, ob.session_uid


def _copy_number(name: str) -> int:
    number = re.search(r"\.(\d{3,})$", name)
    return int(number[1]) if number else 0


class OwnedDataBlocks:
    """Finds and makes the blocks of one lift in one scene, while the lift is placed there."""

    def __init__(self, lift: str, scene: bpy.types.Scene) -> None:
        self.lift = lift
        self._kept: set[Any] = set()
        self._blocks: dict[str, dict[str, Any]] = {}
        self.in_scene = set(scene.objects)  # and the objects linked to it since
        own = self._own_objects()
        self._objects = originals(own, lift)
        for ob in own:
            if ob != self._objects[ob[KEY]]:  # the user duplicated one of ours: the copy is theirs
                untag(ob)

    def object(self, key: str, name: str, data: bpy.types.ID, parent: bpy.types.Collection) -> bpy.types.Object:
        """Return our object `key`, made if missing, with this name and data. It goes into our collection `parent` if it
        is in no collection of the scene; if the user moved it to another, it stays there."""
        ob = self._objects.get(key)
        if ob is None or ob.type != _OBJECT_TYPE[type(data).__name__]:
            ob = bpy.data.objects.new(name, data)
            tag(ob, self.lift, key)
            self._objects[key] = ob
        if ob not in self.in_scene:
            parent.objects.link(ob)
            self.in_scene.add(ob)
        ob.name, ob.data = name, data
        self._kept.add(ob)
        return ob

    def known(self, key: str) -> bpy.types.Object | None:
        """Return our object `key`, None if there is none."""
        return self._objects.get(key)

    def data(self, key: str, create: Callable[[], Any]) -> Any:
        """Return the data of our object `key`, to be filled again. `create` makes it if it is missing or a user's."""
        ob = self._objects.get(key)
        if ob is not None and ob.data is not None and ob.data.users <= 1 and key_of(ob.data, self.lift) is not None:
            return ob.data
        data = create()
        tag(data, self.lift, key)
        return data

    def drop_object(self, key: str) -> None:
        """Remove our object `key`, if it exists, and its data, if nothing else uses it."""
        ob = self._objects.pop(key, None)
        if ob is not None:
            self.in_scene.discard(ob)
            bpy.data.batch_remove([ob, *([ob.data] if ob.data is not None and ob.data.users == 1 else [])])

    def block(self, kind: str, key: str, create: Callable[[], Any]) -> Any:
        """Return our block `key` of `bpy.data.<kind>`, made by `create` if it is missing."""
        known = self._blocks_of(kind)
        if key not in known:
            known[key] = create()
            tag(known[key], self.lift, key)
        self._kept.add(known[key])
        return known[key]

    def drop(self, kind: str, key: str) -> None:
        """Remove our block `key` of `bpy.data.<kind>`, if it exists, even if something uses it."""
        block = self._blocks_of(kind).pop(key, None)
        if block is not None:
            getattr(bpy.data, kind).remove(block)

    def keep(self, block: Any) -> None:
        """Protect one of our blocks from `sweep`."""
        self._kept.add(block)

    def keep_known(self, is_kept: Callable[[str], bool]) -> None:
        """Protect our objects from `sweep` whose key `is_kept` accepts."""
        self._kept.update(ob for key, ob in self._objects.items() if is_kept(key))

    # All of a kind at once: each removal goes through the whole file, 20 ms with thousands of instances.

    def sweep(self) -> None:
        """Remove the lift's objects that were not used while it was placed, then their unused data."""
        bpy.data.batch_remove([ob for ob in self._own_objects() if ob not in self._kept])
        self.sweep_data()

    def sweep_data(self) -> None:
        """Remove the lift's data that was not used while it was placed and that nothing else uses."""
        for kind in _DATA:
            for _ in range(2):  # a group of nodes may use another
                own = [b for b in getattr(bpy.data, kind) if key_of(b, self.lift) is not None and b not in self._kept]
                bpy.data.batch_remove([block for block in own if block.users - block.use_fake_user == 0])

    def sweep_only(self, *prefixes: str) -> None:
        """Remove objects as `sweep` does, if their key has one of these prefixes, and unused clouds and meshes."""
        own = [ob for ob in self._own_objects() if ob[KEY].startswith(prefixes) and ob not in self._kept]
        theirs = {ob.data for ob in own if ob.data is not None and ob.data.users == 1}
        data = [each for each in (*bpy.data.pointclouds, *bpy.data.meshes) if key_of(each, self.lift) is not None]
        bpy.data.batch_remove([*own, *(each for each in data if not each.users or each in theirs)])

    def _blocks_of(self, kind: str) -> dict[str, Any]:
        """Return our blocks of `bpy.data.<kind>` by key; they are looked up only once."""
        if kind not in self._blocks:
            found = {key_of(block, self.lift): block for block in [*getattr(bpy.data, kind)][::-1]}
            self._blocks[kind] = {key: block for key, block in found.items() if key is not None}
        return self._blocks[kind]

    def _own_objects(self) -> list[bpy.types.Object]:
        """Return our objects in this scene or in none. A full copy of the scene keeps its own copies of our objects."""
        ours = [ob for ob in bpy.data.objects if key_of(ob, self.lift) is not None]
        return [ob for ob in ours if ob in self.in_scene or not ob.users_scene]


FOLDER, SCENE = "plgs_lift_folder", "plgs_scene_folder"
"""Properties of a lift's collection: the folders of the lift, empty before there is one, and of its scene."""
ESTIMATED = "plgs_estimated"
"""Its property for what of the scene was not measured, a line each."""

PLACE = "plgs_place"
"""Property of an imported scene's collection: how the scene was read (masks, up, format, depth), as text."""

RESULT = "plgs_result"
"""Property of a lift's collection: the size and a checksum of the list of objects that the scene shows."""
COMPARED = 1 << 18
"""Bytes of a file that are compared with what is shown."""

GAUSSIANS = "gaussians"
"""Key of the object with a lift's splats."""
_ROOT = "lift"


def lifts_in(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """Return the collections of the lifts that were placed in a scene."""
    return [c for c in scene.collection.children_recursive if text_of(c, LIFT) and text_of(c, KEY) == _ROOT]


def folder_of(root: bpy.types.Collection) -> Path:
    """Return the folder of a placed lift, given its collection."""
    return absolute(text_of(root, FOLDER))


def overview_of(root: bpy.types.Collection) -> bpy.types.Object | None:
    """Return a lift's overview camera; None if the user removed it."""
    return next((ob for ob in root.all_objects if key_of(ob, root[LIFT]) == "overview"), None)


def shows(root: bpy.types.Collection, lift: Path) -> bool:
    """Whether a collection shows the current result in this folder. Raises OSError if that is unreadable."""
    return text_of(root, RESULT) == mark_of(lift) != ""


def mark_of(lift: Path) -> str:
    """A text that tells a lift's result from earlier ones, stored as RESULT; "" without a result. Raises OSError."""
    path, at = version_of(lift)
    if at is None:
        return ""
    with open(path, "rb") as file:
        return f"{at[1]} {zlib.crc32(file.read(COMPARED))}"


gone: set[str] = set()
"""The keys of lifts that are not where the opened file says."""


def note_gone(error: Exception) -> None:
    """If an error says that a lift's folder is missing, add all lifts in that folder to `gone`."""
    if isinstance(error, PlgsError) and error.key == "no-lift-folder":
        for root in (root for scene in bpy.data.scenes for root in lifts_in(scene)):
            if text_of(root, FOLDER) and str(folder_of(root)) == error.where:
                gone.add(root[LIFT])


def is_placed(lift: Path, scene: bpy.types.Scene) -> bool:
    """Whether the lift's result was placed in `scene`."""
    return any(is_same_place(text_of(root, FOLDER), lift) for root in lifts_in(scene_to_fill(scene)))


def root_of_placed(lift: Path, scene: bpy.types.Scene) -> bpy.types.Collection:
    """Return the collection of the lift that is placed in `scene`. Raises PlgsError if it is not there."""
    for root in lifts_in(scene_to_fill(scene)):
        if is_same_place(text_of(root, FOLDER), lift):
            return root
    raise PlgsError("lift-elsewhere", "is not in this scene", lift, "Show the lift's result first.")


@dataclass(frozen=True)
class Placed:
    """The place of a lift in the file, by names that stay valid after undo and after opening another file."""

    lift: str
    scene: str

    def find(self) -> tuple[bpy.types.Collection, bpy.types.Scene] | None:
        """Return the lift's collection and its scene; None if either is gone."""
        scene = bpy.data.scenes.get(self.scene)
        for root in lifts_in(scene) if scene is not None else ():
            if root[LIFT] == self.lift:
                return root, scene
        return None


def root_collection(scene_folder: Path, lift_folder: Path | None, scene: bpy.types.Scene) -> bpy.types.Collection:
    """Return the collection for this lift, which may have been moved on disk: the lift's own, or that of its scene if
    it has no lift, or a new one. Without a lift, any of the scene or a new one. Raises PlgsError, OSError."""
    _check_name(scene_folder)
    ours = [root for root in lifts_in(scene) if root.library is None and root.override_library is None]
    of_scene = [root for root in ours if is_same_place(text_of(root, SCENE), scene_folder)]
    if lift_folder is None:
        found = of_scene
    else:
        _check_name(lift_folder)
        of_lift = (is_same_place(text_of(root, FOLDER), lift_folder) or shows(root, lift_folder) for root in ours)
        found = [root for root, is_same in zip(ours, of_lift, strict=True) if is_same]
        found += [root for root in of_scene if not text_of(root, FOLDER)]
    if found:
        root = found[0]
    else:
        root = bpy.data.collections.new("PLGS")
        tag(root, uuid4().hex, _ROOT)
        root[FOLDER] = ""
        scene.collection.children.link(root)
    is_alone = of_scene in ([], [root])
    root.name = f"PLGS {scene_folder.name if is_alone or lift_folder is None else lift_folder.name}"
    root[SCENE] = str(scene_folder.absolute())
    if lift_folder is not None:
        root[FOLDER] = str(lift_folder)
    return root


def scene_to_fill(scene: bpy.types.Scene) -> bpy.types.Scene:
    """The scene itself or, if it holds a lift's passes, the scene with the lift. Raises PlgsError if it is gone."""
    if KEY not in scene:
        return scene
    for other in bpy.data.scenes:
        if KEY not in other and any(root[LIFT] == scene.get(LIFT) for root in lifts_in(other)):
            return other
    raise PlgsError("scene-of-passes", "is only for the passes of a lift", scene.name, "Switch to a scene of your own.")


def _check_name(folder: Path) -> None:
    """Raise PlgsError if Blender cannot store the path: it supports only UTF-8 and turns backslashes into slashes."""
    path = str(folder.absolute())
    is_text = path.isascii() or path.encode(errors="ignore") == os.fsencode(path)
    if not is_text or (os.sep == "/" and "\\" in path):
        what = "has a name that Blender cannot open"
        shown = path.encode(errors="backslashreplace").decode()
        fix = "Rename it: letters of any script, but no backslash and no broken characters."
        raise PlgsError("bad-name", what, shown, fix)


def is_same_place(stored: str, folder: Path) -> bool:
    """Whether a path stored in a .blend is this folder. The stored path is not looked up on disk, as somebody else's
    file may name a disk that never answers."""
    return bool(stored) and _normal(bpy.path.abspath(stored)) in (_normal(folder), _normal(folder.resolve()))


def _normal(path: str | Path) -> str:
    return os.path.normcase(os.path.abspath(path))


def child_collection(
    root: bpy.types.Collection, name: str, scene: bpy.types.Scene | None = None, hidden: bool = False
) -> bpy.types.Collection:
    """Return our collection `name` in the root, made if missing. If ``hidden``, its eye and camera are off at first."""
    key = f"collection:{name}"
    for child in root.children:
        if key_of(child, root[LIFT]) == key:
            return child
    child = bpy.data.collections.new(name)
    tag(child, root[LIFT], key)
    root.children.link(child)
    if hidden and scene is not None:
        hide(child, scene)
    return child


def hide(collection: bpy.types.Collection, scene: bpy.types.Scene) -> None:
    """Hide a collection in a scene's viewports and renders (its eye and camera icons)."""
    collection.hide_render = True
    for view_layer in scene.view_layers:
        if view_layer.layer_collection is None:  # Blender 5 makes it when the scene is shown for the first time
            view_layer.update()
        for found in layer_collections(view_layer.layer_collection):
            if found.collection == collection:
                found.hide_viewport = True


def is_child(child: bpy.types.Collection, root: bpy.types.Collection, name: str) -> bool:
    """Whether `child_collection` made `child` as the collection `name` of this root."""
    return key_of(child, root[LIFT]) == f"collection:{name}"


def layer_collections(top: bpy.types.LayerCollection) -> list[bpy.types.LayerCollection]:
    """Return a layer collection and all below it."""
    return [top, *(found for child in top.children for found in layer_collections(child))]
