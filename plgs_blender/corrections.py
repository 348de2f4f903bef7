"""Correct a placed lift. Corrections are saved on disk, shown in the scene at once and undone with Blender's own undo.

The lift's collection stores which edits the scene shows. Undo and redo change that along with everything else, and
handlers here update the file to match. They never touch the edits of other programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

import bpy
import numpy as np
from numpy.typing import NDArray

from ..engine.corrections import making
from ..engine.corrections.edits import CORRECTIONS as FILE
from ..engine.corrections.edits import Edit, read_edits
from ..engine.corrections.proposals import BY_VIEWS, class_of_parts
from ..engine.corrections.replay import Replay
from ..engine.corrections.result import CorrectedResult, correct, set_undone, undo
from ..engine.corrections.result import put_back as engine_put_back
from ..engine.errors import PlgsError
from .boxes import INSTANCE, TOGETHER, name_object, place_boxes
from .clouds import SurfaceGrid, place_anchors, place_semantic_points
from .errors import EXPECTED, with_field_names
from .inspecting import selection
from .inspecting.lists import fill_lists, fill_masks
from .inspecting.looks import SPLATS, has, removed_objects
from .meshes import CORRECTIONS
from .owned import (
    COMPARED,
    FOLDER,
    LIFT,
    RESULT,
    OwnedDataBlocks,
    child_collection,
    folder_of,
    gone,
    lifts_in,
    mark_of,
    note_gone,
    shows,
    text_of,
)
from .proposals import PROPOSALS, keep_proposals, proposal_of
from .results import LiftResult, listed_in
from .splats import place_gaussians

EDITS = "plgs_edits"
"""Property of a lift's collection: the uids of the edits that the scene shows, as one text."""

outdated: set[str] = set()
"""The keys of lifts that differ on disk from what the opened file shows."""

_mine: dict[str, set[str]] = {}  # by lift folder: the uids of the edits made by this Blender process
failed: list[str] = []
"""Why the file could not follow the last undo, for the panel; empty if it could."""

Make = Callable[[Replay, int], Edit]
Choose = Callable[[NDArray[np.float32]], NDArray[np.bool_]]
"""Maps points [N, 3] to whether each is chosen, bool [N]."""


def edit(root: bpy.types.Collection, make: Make) -> Edit:
    """Save an edit of a lift, which ``make`` returns, and show it. Raises PlgsError if ``make`` does; OSError."""
    made, result = _correct(root, make)
    show_corrections(root, result)
    return made


def _correct(root: bpy.types.Collection, make: Make) -> tuple[Edit, CorrectedResult]:
    made, result = correct(folder_of(root), make, listed_in(folder_of(root)))
    _mine.setdefault(str(folder_of(root)), set()).add(made.uid)
    return made, result


def show_edit(root: bpy.types.Collection, uid: str, result: CorrectedResult) -> None:
    """Show the edit ``uid``, made by an engine for this Blender, by its ``result``, so that undo reverts it. Raises
    PlgsError as `show_corrections` does."""
    _mine.setdefault(str(folder_of(root)), set()).add(uid)
    show_corrections(root, result)


def undo_last(root: bpy.types.Collection) -> Edit:
    """Undo the last edit in the file, whoever made it, and show the result. Raises PlgsError without any; OSError."""
    undone, result = undo(folder_of(root), listed_in(folder_of(root)))
    show_corrections(root, result)
    return undone


def put_back(root: bpy.types.Collection, instance: int) -> Edit:
    """Put a removed object back, with all that were removed with it. Raises PlgsError if it is not removed; OSError."""
    undone, result = engine_put_back(folder_of(root), [instance], listed_in(folder_of(root)))
    show_corrections(root, result)
    return undone


def show_corrections(root: bpy.types.Collection, result: CorrectedResult) -> None:
    """Show a placed lift as corrected; what the user moved or renamed stays. Raises PlgsError if splats are gone."""
    scene, layer = bpy.context.scene, bpy.context.view_layer
    owned = OwnedDataBlocks(root[LIFT], scene)
    own = selection.objects_by_key(root).items()
    cameras = [ob for key, ob in own if key.startswith("frame:") and ob.type == "CAMERA"]
    grid = SurfaceGrid.of(result.points.xyz)
    centres = np.array([ob.matrix_world.translation[:] for ob in cameras] or [[0.0, 0.0, 0.0]])  # users may delete them
    clouds = child_collection(root, "Semantic points")
    place_semantic_points(
        owned, clouds, result.points, grid=grid, normals=grid.normals(centres), classes=result.classes
    )
    place_anchors(owned, child_collection(root, "Anchors", scene, hidden=True), result.anchors())
    place_boxes(owned, child_collection(root, "Instances"), result.instances, anew=False)
    owned.sweep_only("class:", INSTANCE, TOGETHER, "anchors")
    lists, before = root.plgs, removed_objects(root)
    rows, at = lists.instances, lists.instance_index
    active = rows[at].instance_id if 0 <= at < len(rows) else 0
    fill_lists(root, result, anew=False)
    fill_masks(root, result.instances, result.classes)
    if active in {row.instance_id for row in lists.instances}:
        selection.select_instance(root, active, layer)
    if removed_objects(root) != before and has(root, SPLATS):
        place_gaussians(root, scene)
    remember(root, result)


def answer(root: bpy.types.Collection, instance: int, *, keep: bool) -> Edit:
    """Apply an object's proposal, except BY_VIEWS, which needs an engine; with ``keep``, accept the object. Raises
    PlgsError if it has no proposal; OSError."""
    one = proposal_of(root, instance)
    if keep:
        return accept(root, [one.instance])
    match one.answer:
        case "reclass":
            return edit(root, lambda state, _: making.reclass(state, [one.instance], one.class_id))
        case "merge":
            return merge(root, [one.other, one.instance])
        case "split":
            return split_parts(root, one.instance)
    if one.answer == BY_VIEWS:
        raise PlgsError("needs-engine", "a split by views needs an engine", root.name, "Press Split by Views.")
    return delete(root, one.instance, around=True)


def remember(root: bpy.types.Collection, result: LiftResult | CorrectedResult) -> None:
    """Store in the collection which edits the scene shows and, if proposals were asked for, the present proposals."""
    root[EDITS] = " ".join(each.uid for each in result.edits if not each.undone)
    root[CORRECTIONS] = result.label_fingerprint
    with suppress(OSError):
        root[RESULT] = mark_of(folder_of(root))
    outdated.discard(root[LIFT])
    gone.discard(root[LIFT])
    if isinstance(result, CorrectedResult) and text_of(root, PROPOSALS):
        keep_proposals(root, result)


def look_for_changes(root: bpy.types.Collection) -> None:
    """Add a lift to `outdated` if its files differ from what the scene shows, or to `gone` if its folder is missing.
    Raises PlgsError for a damaged file; OSError."""
    lift = folder_of(root)
    if not lift.is_dir():
        gone.add(root[LIFT])
        return
    is_same = not text_of(root, RESULT) or shows(root, lift)  # empty: placed by an earlier version
    if is_same and (not (lift / FILE).exists() or (lift / FILE).stat().st_size <= COMPARED):
        is_same = {*text_of(root, EDITS).split()} == {each.uid for each in read_edits(lift) if not each.undone}
    if not is_same:
        outdated.add(root[LIFT])


def chosen_instances(root: bpy.types.Collection, named: str, context: bpy.types.Context) -> list[int]:
    """Return the ids in a text such as "3 5"; all ids for "all"; for "", those of the selected boxes, the active one
    first, else of the list's active row. Raises PlgsError for other texts, and if nothing is chosen."""
    if named.strip() == "all":
        return [row.instance_id for row in root.plgs.instances]
    if named.strip():
        try:
            return [int(each) for each in named.replace(",", " ").split()]
        except ValueError as error:
            what = f"{named!r} does not name objects"
            raise PlgsError("not-objects", what, root.name, "Give their ids, such as 3 5.") from error
    return selection.selected_instances(root, context.view_layer) or [selection.row_of(root, 0).instance_id]


def class_named(root: bpy.types.Collection, name: str) -> int:
    """Return the id of the lift's class with this name or number. Raises PlgsError if there is none."""
    return making.class_of(listed_in(folder_of(root))[0], name)


def class_choices(root: bpy.types.Collection, instance: int) -> list[str]:
    """Return all class names of the lift, first those for which most of the object's masks voted."""
    votes: dict[str, float] = {}
    for row in root.plgs.instances:
        if row.instance_id == instance:
            for mask in row.masks:
                votes[mask.class_name] = votes.get(mask.class_name, 0.0) + mask.score
    names = [one.name for one in listed_in(folder_of(root))[0].categories if one.id]
    return sorted(names, key=lambda name: (-votes.get(name, 0.0), name))


def rename(root: bpy.types.Collection, instance: int, name: str) -> Edit:
    """Rename an object. If only this Blender changed the corrections, only the object's row, box and mesh are updated,
    as one of their fields may call this; otherwise all of the lift. Raises PlgsError for a bad name; OSError."""
    made, result = _correct(root, lambda state, _: making.rename(state, instance, name))
    if root[LIFT] in outdated:  # the view lacks other edits, too
        show_corrections(root, result)
    row = selection.row_of(root, instance)
    row.known_name = row.name = made.name  # in this order, or setting `name` would rename again
    _name_objects(root, instance, made.name)
    remember(root, result)
    return made


def _rename_by_field(root: bpy.types.Collection, instance: int, name: str) -> None:
    """Apply a rename made in a list or the outliner. If that fails, restore the old name; `failed` then says why."""
    failed.clear()
    try:
        rename(root, instance, name)
    except EXPECTED as error:
        note_gone(error)
        failed.append(with_field_names(error))
        if not bpy.app.background and bpy.context.window is not None:  # a field cannot report
            say = f"Not renamed. {failed[-1]}"
            bpy.context.window_manager.popup_menu(lambda menu, _: menu.layout.label(text=say), icon="ERROR")
        row = selection.row_of(root, instance)
        row.name = row.known_name
        _name_objects(root, instance, row.known_name)


def _name_objects(root: bpy.types.Collection, instance: int, name: str) -> None:
    for ob in selection.objects_by_key(root).values():
        if selection.instance_of(ob) == instance:
            name_object(ob, name)


def reclass(root: bpy.types.Collection, instances: Sequence[int], class_name: str) -> Edit:
    """Change the class of objects. Raises PlgsError for an unknown class or object; OSError."""
    class_id = class_named(root, class_name)
    return edit(root, lambda state, _: making.reclass(state, instances, class_id))


def merge(root: bpy.types.Collection, instances: Sequence[int]) -> Edit:
    """Merge all objects into the first. Raises PlgsError for fewer than two objects; OSError."""
    return edit(root, lambda state, _: making.merge(state, instances))


def delete(root: bpy.types.Collection, instance: int, *, around: bool) -> Edit:
    """Delete an object. If ``around``, its points join what is around them; otherwise they belong to no object."""
    return edit(root, lambda state, _: making.delete(state, instance, around=around))


def delete_around(root: bpy.types.Collection, instances: Sequence[int]) -> None:
    """Delete objects, whose points join what is around them, and update the scene once. Raises PlgsError, OSError;
    objects deleted before an error stay deleted."""
    result = None
    try:
        for instance in instances:
            _, result = _correct(root, partial(lambda one, state, _: making.delete(state, one), instance))
    finally:
        if result is not None:
            show_corrections(root, result)


def accept(root: bpy.types.Collection, instances: Sequence[int]) -> Edit:
    """Mark objects as correct. Raises PlgsError for an unknown object; OSError."""
    return edit(root, lambda state, _: making.accept(state, instances))


def split_parts(root: bpy.types.Collection, instance: int) -> Edit:
    """Split an object into its connected parts. Raises PlgsError if it is in one piece; OSError."""
    return _split(root, instance, making.parts_of)


def split_plane(root: bpy.types.Collection, instance: int, point: Sequence[float], normal: Sequence[float]) -> Edit:
    """Split an object by the plane through ``point`` with this ``normal``, in world metres."""
    return _split(root, instance, lambda xyz: making.sides_of(xyz, point, normal))


def _split(
    root: bpy.types.Collection, instance: int, part_of: Callable[[NDArray[np.float32]], NDArray[np.int64]]
) -> Edit:
    """Split an object; ``part_of`` maps its points [n, 3] to part numbers."""

    def make(state: Replay, first_id: int) -> Edit:
        part = part_of(state.points_of(instance))
        return making.split(state, instance, part, first_id, class_of_parts(folder_of(root), state, instance, part))

    return edit(root, make)


def crop(root: bpy.types.Collection, instance: int) -> Edit:
    """Give an object exactly those points in its box, which users may move or scale, that are its own or have its class
    but no object. Its points outside keep the class but lose the object. Raises PlgsError if nothing changes."""
    box = selection.box_of(root, instance)
    return edit(root, lambda state, _: making.crop(state, instance, inside_box(box, state.xyz)))


def assign(
    root: bpy.types.Collection, choose: Choose, instance: int, class_name: str = "", *, is_new: bool = False
) -> Edit:
    """Assign the points that ``choose`` selects to the object ``instance``. If that is 0, assign them to the class
    ``class_name`` or, with ``is_new``, to a new object of that class."""
    class_id = 0 if instance else class_named(root, class_name)

    def make(state: Replay, first_id: int) -> Edit:
        new_id = first_id if is_new else 0
        return making.assign(state, choose(state.xyz), instance, class_id=class_id, new_id=new_id)

    return edit(root, make)


def in_region(name: str) -> Choose:
    """Return a function that selects the points in the object ``name``'s box. Raises PlgsError if there is none."""
    region = bpy.data.objects.get(name)
    if region is None:
        raise PlgsError("no-object", "there is no such object", name, "Name an object whose box contains the points.")
    return partial(inside_box, region)


def inside_box(box: bpy.types.Object, xyz: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which points [N, 3] lie within an object's current bounding box, bool [N]."""
    corners = np.array([corner[:] for corner in box.bound_box])
    local = np.c_[xyz, np.ones(len(xyz))] @ np.array(box.matrix_world.inverted_safe()).T
    return ((local[:, :3] >= corners.min(axis=0)) & (local[:, :3] <= corners.max(axis=0))).all(axis=1)


@bpy.app.handlers.persistent
def _follow_undo(*_arguments: object) -> None:
    """Repeat in the corrections' file what Blender's undo or redo changed."""
    failed.clear()
    for scene in bpy.data.scenes if _mine else ():
        for root in lifts_in(scene):
            mine = _mine.get(str(folder_of(root)), set()) if text_of(root, FOLDER) else set()
            if not mine:
                continue
            shown = set(text_of(root, EDITS).split())
            try:
                known = {each.uid: each.undone for each in read_edits(folder_of(root)) if each.uid in mine}
                changed = {uid: uid not in shown for uid, undone in known.items() if undone == (uid in shown)}
                if changed:
                    set_undone(folder_of(root), changed)
            except EXPECTED as error:
                failed.append(f"The corrections could not follow: {error}")


HANDLERS = (("undo_post", _follow_undo), ("redo_post", _follow_undo))


def register() -> None:
    selection.renaming.append(_rename_by_field)


def unregister() -> None:
    selection.renaming.remove(_rename_by_field)
    _mine.clear()
    outdated.clear()
    gone.clear()
    failed.clear()
