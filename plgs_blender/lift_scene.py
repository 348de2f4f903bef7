"""Put a finished lift into Blender: `place_lift` into an open scene, `save_lift` into a file.

Only our own data is touched: a collection "PLGS <scene>" with its contents, our data-blocks, the timeline markers bound
to our cameras, and scenes for the passes. Placing a lift again updates it; placing another lift of the same scene hides
the first."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.errors import PlgsError
from ..engine.posed import Camera
from ..engine.posed.ply import read_gaussians
from ..engine.result_files import Instance
from .boxes import INSTANCE, TOGETHER, place_boxes, place_together, shared_out
from .cameras import overview_camera, place_camera, place_camera_path, place_frames
from .clouds import SurfaceGrid, place_anchors, place_depth_clouds, place_semantic_points
from .corrections import remember
from .inspecting import looks
from .inspecting.lists import fill_lists, fill_masks, fill_not_shown, registered
from .inspecting.selection import choose_lift
from .inspecting.views import look_at_room
from .meshes import ReadMeshes, placing_meshes, reading_meshes
from .moving import relate
from .owned import (
    ESTIMATED,
    FOLDER,
    GAUSSIANS,
    KEY,
    LIFT,
    SCENE,
    OwnedDataBlocks,
    Placed,
    child_collection,
    hide,
    is_same_place,
    lifts_in,
    overview_of,
    root_collection,
    root_of_placed,
    scene_to_fill,
    text_of,
)
from .passes import check_layers, place_passes, place_shots
from .results import LiftResult, read_result, reading_result, result_of
from .reuse import leave_holes
from .splat_objects import open_room
from .splats import are_outdated, gaussians_of, place_gaussians, placing_gaussians
from .timeline import mark_timeline, places_of
from .viewport import NEW, all_views, show_materials_in, start_file

_VIEWPOINTS = 200
"""At most this many cameras decide which side of a surface was seen: if there are more, every n-th."""
_AT_ONCE, _MASKS_AT_ONCE = 100, 2000  # boxes and masks placed without a pause: a tenth of a second for each
_WAS_ASKED = "plgs_show_as_asked"
"""Property of a lift's collection: whether the user chose what it is shown as."""
_OVERVIEW_SIZE = 0.4  # display size of the overview camera in metres


def place_lift(lift: Path, scene: bpy.types.Scene) -> bpy.types.Collection:
    """Put a finished lift into a scene, or update it there, and return its collection. The collection is found by the
    folder of the lift or of its scene. If `scene` holds passes, the scene with their lift is used. Raises PlgsError,
    before anything changes, if the lift is not finished or cannot be read."""
    result_of(place_room(result_of(reading_lift(lift)), scene)[1])
    return root_of_placed(lift, scene_to_fill(scene))


@dataclass(frozen=True, eq=False)
class ReadLift:
    """A result and data computed from its points [N]: their grid, their normals float32 [N, 3], and a camera outside
    the room. ``gaussians`` are the rows of its splats; None if it has no splats or Blender reads them itself."""

    result: LiftResult
    grid: SurfaceGrid
    normals: NDArray[np.float32]
    overview: Camera
    gaussians: NDArray[np.void] | None
    meshes: ReadMeshes


def reading_lift(lift: Path) -> Generator[None, None, ReadLift]:
    """Read a lift in parts, so that the window does not freeze. Raises PlgsError if it is unfinished or damaged."""
    result = yield from _reading(lift)
    yield
    splats = result.folder / "result" / "gaussians.ply"
    gaussians = result.splats(read_gaussians(splats)) if splats.is_file() else None
    yield
    meshes = yield from reading_meshes(result.folder)
    xyz, frames = result.points.xyz, result.scene.frames
    grid = SurfaceGrid.of(xyz)
    normals = grid.normals(np.array([frame.camera.centre for frame in frames])[:: 1 + len(frames) // _VIEWPOINTS])
    overview = overview_camera(xyz, normals)
    yield
    return ReadLift(result, grid, normals, overview, gaussians, meshes)


def _placing_rest(read: ReadLift, placed: Placed) -> Generator[None, None, None]:
    """Place everything but cameras, points and first boxes: lists, other boxes, masks, meshes, splats and passes. Stop
    if the lift is removed meanwhile."""
    for do in _objects_in_turn(read.result):
        found = placed.find()
        if found is None:
            return
        with registered():
            do(*found)
        yield
    if read.meshes.parts:
        _hide_surface_until_whole(placed)
    yield from placing_meshes(placed, read.result, read.meshes)
    if read.meshes.parts and (found := placed.find()) is not None:
        leave_holes(found[0])
        with registered():
            looks.apply_lit(found[0])
            looks.apply_catcher(*found)
    for part in (_placing_splats, _placing_passes):
        found = placed.find()
        if found is None:
            return
        yield from part(read, *found)
        yield


def _objects_in_turn(result: LiftResult) -> Iterator[Callable[[bpy.types.Collection, bpy.types.Scene], None]]:
    """Yield functions that list the objects, place the boxes that were not placed at first, then list the masks."""
    yield partial(_list, result)
    own, others = shared_out(result.instances)
    for at in range(_AT_ONCE, len(own), _AT_ONCE):
        yield partial(_place_late, place_boxes, own[at : at + _AT_ONCE])
    if others:
        yield partial(_place_late, place_together, others)
    if len(result.instances) > _AT_ONCE:
        yield lambda root, scene: looks.apply_visibility(root)
        yield lambda root, scene: looks.apply_colours(root)
    masks = np.cumsum([1 + len(one.segments) for one in result.instances])  # objects without masks take time, too
    for _, turn in groupby(enumerate(result.instances), key=lambda each: masks[each[0]] // _MASKS_AT_ONCE):
        own = [one for _, one in turn]
        yield partial(lambda own, root, scene: fill_masks(root, own, result.classes), own)


def _list(result: LiftResult, root: bpy.types.Collection, scene: bpy.types.Scene) -> None:
    fill_lists(root, result)
    fill_not_shown(root, result)
    root[ESTIMATED] = "\n".join(result.estimated)
    leave_holes(root)


def _place_late(
    place: Callable[..., object], instances: list[Instance], root: bpy.types.Collection, scene: bpy.types.Scene
) -> None:
    """Call ``place`` with the boxes' collection and those ``instances`` that no correction has removed since."""
    listed = {row.instance_id for row in root.plgs.instances}
    owned, parent = OwnedDataBlocks(root[LIFT], scene), child_collection(root, "Instances")
    place(owned, parent, [one for one in instances if one.id in listed])


def _placing_splats(read: ReadLift, root: bpy.types.Collection, scene: bpy.types.Scene) -> Iterator[None]:
    placed = Placed(root[LIFT], scene.name)
    if read.gaussians is not None and _wants_splats(root, read):
        yield from placing_gaussians(root, scene, read.gaussians)
    found = placed.find()
    if found is not None:
        root, scene = found
        with registered():
            lists = root.plgs
            # What the user chose, else the first that there is.
            chosen = [lists.show_as] if lists.is_property_set("show_as") else []
            ways = (*chosen, looks.SURFACE, looks.SPLATS)
            lists.show_as = next((kind for kind in ways if looks.has(root, kind)), looks.POINTS)
            _show(root, scene)


def _wants_splats(root: bpy.types.Collection, read: ReadLift) -> bool:
    """Whether to place splats. They would take a quarter of the file, so if a surface is shown instead, they are placed
    only when the user wants to see them."""
    with registered():
        return not read.meshes.parts or bool(root.plgs.show_as == looks.SPLATS)


def _show(root: bpy.types.Collection, scene: bpy.types.Scene) -> None:
    """Show or hide the parts of a placed lift as its lists say."""
    looks.apply_visibility(root)
    if root.plgs.look != looks.PHOTO:
        looks.apply_look(root)
    show_materials_in(scene)
    looks.show_pictures_in(scene)


def _placing_passes(read: ReadLift, root: bpy.types.Collection, scene: bpy.types.Scene) -> Iterator[None]:
    owned = OwnedDataBlocks(root[LIFT], scene)
    place_passes(owned, read.result)
    place_shots(owned, read.result, scene)
    owned.sweep_data()  # images of views that no longer exist
    if bpy.data.filepath:
        relate(Path(bpy.data.filepath))
    yield


def place_room(read: ReadLift, scene: bpy.types.Scene) -> tuple[Placed, Generator[None, None, None]]:
    """Place cameras, points and the first boxes. Returns where they are, and a generator that places the rest."""
    result, grid, normals = read.result, read.grid, read.normals
    scene = scene_to_fill(scene)
    before = lifts_in(scene)
    root = root_collection(result.scene.folder, result.folder, scene)
    if before and root not in before:
        _show_instead(root, before, scene)
    owned = OwnedDataBlocks(root[LIFT], scene)
    frames = result.scene.frames

    cameras = place_frames(owned, child_collection(root, "Cameras"), frames, shows_photo=False)
    clouds = place_semantic_points(
        owned, child_collection(root, "Semantic points"), result.points, grid=grid, normals=normals,
        classes=result.classes,
    )  # fmt: skip
    open_room(owned, clouds)
    place_anchors(owned, child_collection(root, "Anchors", scene, hidden=True), result.anchors)
    own, others = shared_out(result.instances)
    place_boxes(owned, child_collection(root, "Instances"), own[:_AT_ONCE])
    for key in (*(f"{INSTANCE}{one.id}" for one in own[_AT_ONCE:]), *([TOGETHER] if others else ())):
        owned.keep(owned.known(key))  # until it is placed again
    owned.keep_known(lambda key: key.startswith("mesh:"))  # until they are placed again
    place_depth_clouds(owned, root, result.folder)
    splats = owned.known(GAUSSIANS)
    if read.gaussians is not None and _wants_splats(root, read):
        owned.keep(splats)  # until they are filled again
    # A new lift moves the overview back, where a user moved it.
    overview = place_camera(owned, root, "overview", "Overview", camera=read.overview, display_size=_OVERVIEW_SIZE)
    place_camera_path(owned, root, frames, mark_timeline(scene, root, overview, cameras))
    if scene.camera is None:
        scene.camera = overview
    owned.sweep()
    remember(root, result)  # at once: an undo before the next part would take its edits back
    placed = Placed(root[LIFT], scene.name)
    return placed, _placing_rest(read, placed)


def _show_instead(root: bpy.types.Collection, before: list[bpy.types.Collection], scene: bpy.types.Scene) -> None:
    """Let the panels show a lift that was just added, and hide the same scene's lifts that were placed ``before``."""
    for layer in scene.view_layers:
        choose_lift(root, scene, layer)
    for other in before:
        if is_same_place(text_of(other, SCENE), Path(root[SCENE])):
            hide(other, scene)


def place_passes_anew(lift: Path, scene: bpy.types.Scene) -> None:
    """Fill a lift's passes scenes again, after more frames were baked. Raises PlgsError if the lift is not placed."""
    result, scene = result_of(_reading(lift)), scene_to_fill(scene)
    owned = OwnedDataBlocks(root_of_placed(result.folder, scene)[LIFT], scene)
    place_passes(owned, result)
    place_shots(owned, result, scene)


def placing_meshes_anew(lift: Path, scene: bpy.types.Scene, *, asked: bool = True) -> Generator[None, None, int]:
    """Put new meshes into the lift that is placed in `scene`, in parts. Show them if a user ``asked`` for them or has
    not chosen another look. Returns the number of meshes. Raises PlgsError if no lift is placed."""
    scene = scene_to_fill(scene)
    placed = Placed(root_of_placed(lift, scene)[LIFT], scene.name)
    result = yield from _reading(lift)
    meshes = yield from reading_meshes(lift)
    _hide_surface_until_whole(placed)
    count = yield from placing_meshes(placed, result, meshes)
    found = placed.find()
    if found is None:
        return 0
    root, scene = found
    with registered():
        if count and (asked or not root.get(_WAS_ASKED)):
            root.plgs.show_as = looks.SURFACE
        if root.plgs.show_as == looks.SURFACE:  # splats are placed again when they are asked for
            OwnedDataBlocks(root[LIFT], scene).drop_object(GAUSSIANS)
        _show(root, scene)
        looks.apply_lit(root)
        looks.apply_catcher(root, scene)
    return count


def _hide_surface_until_whole(placed: Placed) -> None:
    """Hide a surface until all of it is placed, unless the lift is shown as a surface."""
    if (found := placed.find()) is not None:
        child_collection(found[0], looks.SHOWN_IN[looks.SURFACE])
        with registered():
            looks.apply_show_as(found[0])


def place_depth_clouds_anew(lift: Path, scene: bpy.types.Scene) -> int:
    """Put new depth clouds into a placed lift, and return the number of points. Raises PlgsError for a damaged file."""
    scene = scene_to_fill(scene)
    root = root_of_placed(lift, scene)
    owned = OwnedDataBlocks(root[LIFT], scene)
    count = place_depth_clouds(owned, root, lift)
    owned.sweep_only("depth_cloud:")
    return count


def _reading(lift: Path) -> Generator[None, None, LiftResult]:
    """Read the lift's result, and check that its passes have the layers that we show. Raises PlgsError otherwise."""
    result = yield from reading_result(lift)
    check_layers([*result.passes.values(), *result.shots.values()])
    return result


def save_lift(lift: Path, blend: Path) -> None:
    """Put a finished lift into a .blend, new or existing. Raises PlgsError if that fails, with the file unchanged."""
    blend = blend.absolute()
    read_result(lift)  # before another file is opened
    is_new = not blend.exists()
    scene = start_file() if is_new else open_blend(blend, lift)
    if not is_new and bpy.data.version[:2] > bpy.app.version[:2]:  # saved again, it would lose what is new in it
        what = f"was saved by Blender {bpy.data.version[0]}.{bpy.data.version[1]}, which is newer"
        raise PlgsError("newer-blend", what, blend, "Use that Blender, or give --save another file name.")
    root = place_lift(lift, scene)
    if is_new:
        _dress(scene, root)
    relate(blend)  # a script's Blender may not have our handlers
    saving = bpy.context.preferences.filepaths
    kept = saving.save_version
    if is_same_place(str(blend.parent), lift):  # the lift's own file: no lift.blend1 beside it
        saving.save_version = 0
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(blend), compress=True)
    except RuntimeError as error:
        fix = "Choose a place that you may write to, on a disk with space."
        raise PlgsError("unwritable", f"cannot be written ({str(error).strip()})", blend, fix) from error
    finally:
        saving.save_version = kept


def open_blend(blend: Path, lift: Path, named_by: str = "--save") -> bpy.types.Scene:
    """Open a .blend with its screens. Returns the scene that has the lift, else the active one. Raises PlgsError if the
    file is no readable .blend; ``named_by`` is the option that named it."""
    if not blend.is_file():  # Blender would wait for whoever writes into a FIFO
        raise PlgsError("not-a-file", "is not a file", blend, f"Name another with {named_by}.")
    try:
        bpy.ops.wm.open_mainfile(filepath=str(blend), load_ui=True, use_scripts=False)  # it may be somebody else's
    except RuntimeError as error:
        fix = f"Check that it is a Blender file of this version or an older one, or name another with {named_by}."
        raise PlgsError("unopenable", f"cannot be opened ({str(error).strip()})", blend, fix) from error
    scenes = [s for s in bpy.data.scenes if s.library is None and KEY not in s]
    holding = [s for s in scenes if any(is_same_place(text_of(root, FOLDER), lift) for root in lifts_in(s))]
    current = [bpy.context.scene] if bpy.context.scene in scenes else []
    chosen = [*holding, *current, *scenes]
    if not chosen:
        raise PlgsError("no-scene", "has no scene to put the lift into", blend, f"Name another file with {named_by}.")
    return chosen[0]


def _dress(scene: bpy.types.Scene, root: bpy.types.Collection) -> None:
    """In a file that we created, set the timeline, and show the whole room from the overview camera."""
    overview = overview_of(root)
    assert overview is not None
    places = places_of(root, scene)
    numbers = [number for ob, number in places.items() if "frame" in ob]
    scene.frame_start, scene.frame_end = min(numbers), max(numbers)
    scene.frame_set(places[overview])
    scene.camera = overview
    scene.view_layers[0].update()
    with registered():
        look_at_room(root, overview, all_views())
    root[NEW] = True


def show_lift_as(root: bpy.types.Collection, scene: bpy.types.Scene, kind: str) -> None:
    """Show a lift as POINTS, SPLATS or SURFACE. Splats are placed if they are missing, or were made as squares by a
    Blender without native splats. Raises PlgsError if they cannot be placed or no meshes were made."""
    if kind == looks.SPLATS and (
        not looks.has(root, looks.SPLATS) or (are_outdated(root) and gaussians_of(root).is_file())
    ):
        place_gaussians(root, scene)
        looks.apply_visibility(root)
        looks.apply_look(root)
    if kind == looks.SURFACE and not looks.has(root, looks.SURFACE):
        raise PlgsError("no-meshes", "has no meshes yet", root.name, "Make them first: plgs.make_meshes.")
    root.plgs.show_as, root[_WAS_ASKED] = kind, True
    show_materials_in(scene)
    looks.show_pictures_in(scene)
