"""Correcting a lift in Blender: each edit is seen at once, undone with Blender's own undo, and kept on disk."""

import json
import shutil
import subprocess
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np
import pytest
from plgs.engine.corrections import CORRECTIONS, correct, entropy_of_views, making, read_corrected, read_edits
from plgs.engine.corrections.fills import NOTHING, Fill, path_of, write_fill
from plgs.engine.job import LiftFolder
from plgs.engine.job.task import TaskProgress, TaskState
from plgs.engine.result_files import write_arrays
from plgs.engine.scene_of_lift import scene_of_lift
from plgs.plgs_blender import correction_tools, corrections, lift_scene, registry
from plgs.plgs_blender.correction_tools import Painting
from plgs.plgs_blender.inspecting.selection import boxes_of, clouds_of, follow_selected, ids_of
from plgs.plgs_blender.owned import lifts_in
from plgs.plgs_blender.proposals import kept_proposals
from plgs.ui.corrections_panel import PLGS_PT_corrections

from tests.conftest import ROOT
from tests.raises_key import raises_key, worded
from tests.ui.drawn_panels import Layout, drawn

CHAIR, CABINET = 1, 2


def again() -> bpy.types.Collection:
    """The lift's collection: undo makes every reference stale."""
    return lifts_in(bpy.context.scene)[0]


def names(placed: bpy.types.Collection) -> dict[int, str]:
    return {row.instance_id: row.name for row in placed.plgs.instances}


def points_of(placed: bpy.types.Collection, instance: int) -> int:
    clouds = [cloud for cloud in clouds_of(placed) if "class_id" in cloud]
    return sum(int((ids_of(cloud.data, "instance_id") == instance).sum()) for cloud in clouds)


def test_renaming_an_object_shows_at_once_and_is_kept(placed: bpy.types.Collection, mine: Path) -> None:
    assert bpy.ops.plgs.rename_instance(instance=CHAIR, name="Throne") == {"FINISHED"}
    assert names(placed)[CHAIR] == "Throne" and boxes_of(placed)[CHAIR].name == "Throne box"
    lift_scene.place_lift(mine, bpy.context.scene)
    assert names(placed)[CHAIR] == "Throne" and boxes_of(placed)[CHAIR].name == "Throne box"


def test_changing_an_objects_class_moves_its_points_to_that_cloud(placed: bpy.types.Collection, mine: Path) -> None:
    count = points_of(placed, CHAIR)
    other = next(row.class_name for row in placed.plgs.instances if row.instance_id == CABINET)
    boxes_of(placed)[CHAIR].location.x = 7.0  # moved for a crop
    bpy.ops.plgs.reclass_instances(instances=str(CHAIR), class_name=other)
    row = next(row for row in placed.plgs.instances if row.instance_id == CHAIR)
    assert row.class_name == other and points_of(placed, CHAIR) == count
    assert row.name == f"{other} 2" and boxes_of(placed)[CHAIR].name == f"{other} 2 box"
    assert boxes_of(placed)[CHAIR].location.x == 7.0
    (cloud,) = [one for one in clouds_of(placed) if one.get("class") == other]
    assert int((ids_of(cloud.data, "instance_id") == CHAIR).sum()) == count
    assert not [one for one in clouds_of(placed) if one.get("class") == "chair"]


def test_merging_selected_boxes_keeps_the_active_object(placed: bpy.types.Collection) -> None:
    total = points_of(placed, CHAIR) + points_of(placed, CABINET)
    placed.plgs.show_boxes = True
    for box in boxes_of(placed).values():
        box.select_set(True)
    bpy.context.view_layer.objects.active = boxes_of(placed)[CABINET]
    assert bpy.ops.plgs.merge_instances() == {"FINISHED"}
    assert [*names(placed)] == [CABINET] == [*boxes_of(placed)] and points_of(placed, CABINET) == total


def test_undo_brings_back_a_deleted_object(placed: bpy.types.Collection, mine: Path) -> None:
    count = points_of(placed, CHAIR)
    bpy.ops.ed.undo_push(message="placed")
    bpy.ops.plgs.delete_instance(instance=CHAIR, becomes="NO_OBJECT")
    bpy.ops.ed.undo_push(message="deleted")
    assert CHAIR not in boxes_of(placed) and points_of(placed, CHAIR) == 0
    bpy.ops.ed.undo()
    assert boxes_of(again())[CHAIR].name == "chair 1 box" and points_of(again(), CHAIR) == count
    assert [edit.undone for edit in read_edits(mine)] == [True] and not read_corrected(mine).fingerprint
    bpy.ops.ed.redo()
    assert CHAIR not in boxes_of(again()) and [edit.undone for edit in read_edits(mine)] == [False]


def test_blenders_undo_keeps_edits_of_other_programs(placed: bpy.types.Collection, mine: Path) -> None:
    bpy.ops.ed.undo_push(message="placed")
    bpy.ops.plgs.rename_instance(instance=CHAIR, name="Throne")
    bpy.ops.ed.undo_push(message="renamed")
    from plgs.engine.corrections import correct, making

    correct(mine, lambda state, _: making.rename(state, CABINET, "theirs"))
    bpy.ops.ed.undo()
    assert [(edit.name, edit.undone) for edit in read_edits(mine)] == [("Throne", True), ("theirs", False)]


def test_a_correction_can_be_undone_after_opening_its_saved_file(placed: bpy.types.Collection, tmp_path: Path) -> None:
    bpy.ops.plgs.rename_instance(instance=CHAIR, name="Throne")
    blend = tmp_path / "file.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert names(again())[CHAIR] == "Throne"
    assert bpy.ops.plgs.undo_correction() == {"FINISHED"}
    assert names(again())[CHAIR] == "chair 1"
    with pytest.raises(RuntimeError, match=worded("nothing-to-undo")):
        bpy.ops.plgs.undo_correction()


def test_a_cutting_plane_splits_an_object_where_it_was_dragged(placed: bpy.types.Collection) -> None:
    bpy.ops.plgs.select_instance(instance=CABINET)
    bpy.ops.plgs.place_cut()
    follow_selected(bpy.context.scene, bpy.context.view_layer)  # as a window does: the plane is selected now
    count = points_of(placed, CABINET)
    bpy.ops.plgs.split_instance(by="CUT")
    parts = [number for number in names(placed) if number not in (CHAIR, CABINET)]
    assert len(parts) == 1 and points_of(placed, CABINET) + points_of(placed, parts[0]) == count
    assert 0.2 < points_of(placed, parts[0]) / count < 0.8 and "Cut" not in bpy.data.objects
    with pytest.raises(RuntimeError, match=worded("no-plane")):
        bpy.ops.plgs.split_instance(instance=CABINET, by="CUT")


def test_cropping_an_object_to_its_box_moves_no_other_box(placed: bpy.types.Collection, mine: Path) -> None:
    box, other = boxes_of(placed)[CHAIR], boxes_of(placed)[CABINET]
    other.location.x += 0.7
    other.name = "my box"
    box.scale.z = 0.5
    bpy.context.view_layer.update()
    moved = other.matrix_world.copy()
    count = points_of(placed, CHAIR)
    assert bpy.ops.plgs.crop_instance(instance=CHAIR) == {"FINISHED"}
    assert 0 < points_of(placed, CHAIR) < count and boxes_of(placed)[CHAIR].scale.z == pytest.approx(1.0)
    lift_scene.place_lift(mine, bpy.context.scene)
    bpy.context.view_layer.update()
    kept = boxes_of(placed)[CABINET]
    assert kept.name == "my box" and np.allclose(kept.matrix_world, moved)


def test_points_inside_a_chosen_region_become_a_new_object(placed: bpy.types.Collection) -> None:
    region = bpy.data.objects.new("region", boxes_of(placed)[CHAIR].data)
    region.matrix_world = boxes_of(placed)[CHAIR].matrix_world
    bpy.context.collection.objects.link(region)
    bpy.context.view_layer.update()
    bpy.ops.plgs.assign_points(to="NEW", class_name="cabinet", region="region")
    (new,) = [row for row in placed.plgs.instances if row.instance_id not in (CHAIR, CABINET)]
    assert new.class_name == "cabinet" and points_of(placed, new.instance_id) > 0


def test_impossible_corrections_in_blender_give_a_one_line_error(placed: bpy.types.Collection, mine: Path) -> None:
    calls = [
        (lambda: bpy.ops.plgs.rename_instance(instance=77, name="x"), "no-object 77"),
        (lambda: bpy.ops.plgs.reclass_instances(instances="1", class_name="ghost"), "no-class ghost"),
        (lambda: bpy.ops.plgs.merge_instances(instances="1"), "merge-one"),
        (lambda: bpy.ops.plgs.merge_instances(instances="a b"), "not-objects"),
        (lambda: bpy.ops.plgs.assign_points(to="CLASS", class_name="chair", region="none"), "no-object"),
    ]
    for call, line in calls:
        with pytest.raises(RuntimeError, match=worded(line)):
            call()
    assert not (mine / CORRECTIONS).exists()
    (mine / CORRECTIONS).write_text(json.dumps({"format": 9, "edits": []}))
    with pytest.raises(RuntimeError, match="has format 9"):
        bpy.ops.plgs.rename_instance(instance=CHAIR, name="x")


def test_points_are_painted_and_erased_with_brush_and_rectangle() -> None:
    xyz = np.array([[x, 0.0, -1.0] for x in (-0.5, 0.0, 0.5)], np.float32)
    to_view = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, -0.2], [0, 0, -1, 0]])
    one = Painting.of(xyz)

    def drag(*places: tuple[float, float], is_box: bool = False, is_eraser: bool = False) -> list[bool]:
        one.press(places[0], is_box=is_box, is_eraser=is_eraser)
        for place in places[1:]:
            one.move(place)
        one.release(to_view, (200, 100))
        return one.chosen.tolist()

    assert drag((50.0, 50.0), (51.0, 50.0)) == [True, False, False]
    assert drag((90.0, 90.0), (160.0, 10.0), is_box=True) == [True, True, True]
    assert drag((100.0, 50.0), is_eraser=True) == [True, False, True]
    one.move((150.0, 50.0))  # without the button
    one.release(to_view, (200, 100))
    assert one.choose(xyz).tolist() == [True, False, True]
    with raises_key("points-changed"):
        one.choose(xyz[:2])


def test_proposed_corrections_are_shown_and_answered_one_by_one(placed: bpy.types.Collection, mine: Path) -> None:
    content = json.loads((mine / "result" / "instances.json").read_text())
    for segment in content["instances"][1]["segments"]:
        segment["class_id"] = content["instances"][0]["class_id"]
    (mine / "result" / "instances.json").write_text(json.dumps(content))
    with pytest.raises(RuntimeError, match=worded("no-proposal")):
        bpy.ops.plgs.answer_proposal()
    assert bpy.ops.plgs.propose_corrections() == {"FINISHED"}
    (one,), progress = kept_proposals(placed)
    assert (one.instance, one.answer, progress) == (CABINET, "reclass", "0 of 2 corrected or accepted")
    assert bpy.ops.plgs.go_to_proposal() == {"FINISHED"}
    assert bpy.context.view_layer.objects.active == boxes_of(placed)[CABINET]
    bpy.ops.plgs.answer_proposal(instance=CABINET)
    assert {row.class_name for row in placed.plgs.instances} == {"chair"}
    assert kept_proposals(placed) == ([], "1 of 2 corrected or accepted")
    bpy.ops.plgs.undo_correction()
    bpy.ops.plgs.answer_proposal(keep=True)
    assert [row.class_name for row in placed.plgs.instances] == ["chair", "cabinet"]
    assert kept_proposals(placed) == ([], "1 of 2 corrected or accepted")


def test_next_uncertain_frame_visits_each_frame_once(placed: bpy.types.Collection, mine: Path) -> None:
    points = read_corrected(mine).points
    frames = [ob for ob in placed.all_objects if ob.type == "CAMERA" and "frame" in ob]
    chair = points.instance_id == CHAIR
    doubtful = replace(points, confidence=np.where(chair, 0.5, 1.0).astype(np.float32))
    write_arrays(mine / "result" / "semantic_points.npz", doubtful)
    visited = []
    for _ in range(len(frames)):
        assert bpy.ops.plgs.next_uncertain_frame() == {"FINISHED"}
        visited.append(bpy.context.scene.camera["frame"])
    assert sorted(visited) == sorted(ob["frame"] for ob in frames)
    cameras = {frame.name: frame.camera for frame in scene_of_lift(LiftFolder.open(mine)).frames}
    entropy = entropy_of_views(doubtful, [cameras[name] for name in visited])
    assert (np.diff(entropy) <= 0).all() and entropy[0] > entropy[-1] >= 0
    bpy.ops.plgs.next_uncertain_frame()
    assert bpy.context.scene.camera["frame"] == visited[0], "after the last it begins again"


@pytest.mark.skipif(find_spec("torch") is None, reason="the engine runs in another Python")
def test_split_by_views_separates_merged_objects(lift: Path, tmp_path: Path) -> None:
    mine = Path(shutil.copytree(lift.parent, tmp_path / "both")) / lift.name
    placed = lift_scene.place_lift(mine, bpy.context.scene)
    count = points_of(placed, CHAIR)
    bpy.ops.plgs.merge_instances(instances=f"{CABINET} {CHAIR}")
    bpy.ops.ed.undo_push(message="merged")
    stopped = correction_tools.split_by_views(placed, CABINET)
    assert bpy.ops.plgs.cancel_split() == {"FINISHED"} and stopped.was_cancelled and stopped.error is None
    assert [edit.kind for edit in read_edits(mine)] == ["merge"] and not bpy.ops.plgs.cancel_split.poll()
    assert bpy.ops.plgs.split_by_views(instance=CABINET) == {"FINISHED"}
    bpy.ops.ed.undo_push(message="split")
    (new,) = [row for row in placed.plgs.instances if row.instance_id != CABINET]
    assert new.class_name == "chair" and abs(points_of(placed, new.instance_id) / count - 1) < 0.05
    bpy.ops.ed.undo()
    assert [*boxes_of(again())] == [CABINET] and [edit.undone for edit in read_edits(mine)] == [False, True]
    bpy.ops.ed.redo()
    with pytest.raises(RuntimeError, match=worded("split-one-part")):
        bpy.ops.plgs.split_by_views(instance=new_id(again()))
    registry.forget_all()


def test_a_split_written_before_its_engine_was_stopped_is_shown(mine: Path) -> None:
    """The engine may be killed between writing the edit and its answer."""
    placed = lift_scene.place_lift(mine, bpy.context.scene)
    known = {edit.uid for edit in read_edits(mine)}
    follower: Any = SimpleNamespace(state=TaskState.CANCELLED, is_running=False, error=None, poll=bool, close=bool)
    follower.progress = TaskProgress()
    unmade = correction_tools.SplitByViews(mine, follower, known)
    unmade.poll(bpy.context.scene)
    assert unmade.was_cancelled and not unmade.undo_step and "cancelled" in unmade.message
    correct(mine, lambda state, free: making.split(state, CHAIR, np.arange(len(state.points_of(CHAIR))) % 2, free))
    split = correction_tools.SplitByViews(mine, follower, known)
    split.poll(bpy.context.scene)
    assert split.has_finished and not split.was_cancelled and split.message == "1 new object" and split.undo_step
    assert new_id(placed) in boxes_of(placed) and new_id(placed) not in {CABINET, CHAIR}


def new_id(placed: bpy.types.Collection) -> int:
    """The object that an edit made."""
    return max(row.instance_id for row in placed.plgs.instances)


def test_a_removed_object_leaves_filled_floor_and_can_be_put_back(mine: Path) -> None:
    """As the engine writes it: shown, undone, redone, listed, and put back."""
    placed = lift_scene.place_lift(mine, bpy.context.scene)
    count, before = points_of(placed, CHAIR), read_corrected(mine)
    at = before.points.xyz[before.points.instance_id == CHAIR][:40] * np.float32([1, 1, 0])
    ones = np.ones(len(at), np.float32)
    fill = Fill(
        NOTHING.cells, at, np.full_like(at, 0.01), np.tile(np.float32([1, 0, 0, 0]), (len(at), 1)),
        np.full_like(at, 0.5),
        np.full(len(at), -before.classes.categories[1].id, np.int32), ones, ones > 0,
    )  # fmt: skip
    bpy.ops.plgs.make_objects(instances=str(CHAIR))
    bpy.ops.ed.undo_push(message="placed")
    digest, known = write_fill(path_of(mine, "f1"), fill), {edit.uid for edit in read_edits(mine)}
    correct(mine, lambda state, _: making.remove(state, [CHAIR], "f1", digest))
    follower: Any = SimpleNamespace(state=TaskState.FINISHED, is_running=False, error=None, poll=bool, close=bool)
    follower.progress = TaskProgress()
    removal = correction_tools.RemoveObjects(mine, follower, known)
    removal.poll(bpy.context.scene)
    assert removal.message == "1 object removed" and removal.undo_step == "Remove Objects"
    bpy.ops.ed.undo_push(message="removed")
    assert CHAIR not in names(again()) and points_of(again(), CHAIR) == 0 < count
    assert [*corrections.removed_objects(again())] == [CHAIR]
    listed = drawn().partition("plgs.undo_correction")[2].splitlines()
    row = listed.index("chair 1")
    assert listed[row + 1].startswith("plgs.make_objects") and "plgs.put_back" in listed[row + 1 : row + 4]
    assert [ob for ob in bpy.data.objects if ob.get("instance_id") == CHAIR], "the object itself, which can be moved"
    assert sum(len(cloud.data.points) for cloud in clouds_of(again()) if "class_id" in cloud) == (
        len(before.points.xyz) - count + len(at)
    )
    bpy.ops.ed.undo()
    assert CHAIR in names(again()) and [edit.undone for edit in read_edits(mine)] == [True]
    bpy.ops.ed.redo()
    assert CHAIR not in names(again()) and [edit.undone for edit in read_edits(mine)] == [False]
    assert bpy.ops.plgs.put_back(instance=CHAIR) == {"FINISHED"}
    assert CHAIR in names(again()) and points_of(again(), CHAIR) == count and not corrections.removed_objects(again())
    assert "plgs.put_back" not in drawn()


def test_a_stopped_removal_of_an_object_changes_nothing(lift: Path, tmp_path: Path) -> None:
    mine = Path(shutil.copytree(lift.parent, tmp_path / "both")) / lift.name
    placed = lift_scene.place_lift(mine, bpy.context.scene)
    assert "plgs.remove_instances" in drawn() and "plgs.cancel_removal" not in drawn()
    stopped = correction_tools.remove_objects(placed, [CHAIR])
    assert "plgs.cancel_removal" in drawn()
    header: list[str] = []
    PLGS_PT_corrections.draw_header_preset(SimpleNamespace(layout=Layout(header)), None)
    assert "Removing 0 %" in header, "X works while the panel is closed"
    assert bpy.ops.plgs.cancel_removal() == {"FINISHED"} and stopped.was_cancelled and stopped.error is None
    assert not read_edits(mine) and CHAIR in names(again())
    registry.forget_all()


def test_an_engine_process_removes_an_object_from_the_lift(room: Path, tmp_path: Path, quick_python: Path) -> None:
    quick = ["--steps", "5", "--set", "voxel_size=0.2", "--set", "warm_start=false", "--bake", "none"]
    command = [quick_python, ROOT / "engine/__main__.py", "lift", room, "-o", tmp_path / "lift", *quick]
    subprocess.run([*map(str, command)], check=True, capture_output=True)
    placed = lift_scene.place_lift(tmp_path / "lift", bpy.context.scene)
    number = next(number for number, name in names(placed).items() if name == "chair 1")
    assert bpy.ops.plgs.remove_instances(instances=str(number), make_objects=True) == {"FINISHED"}
    assert number not in names(again()) and points_of(again(), number) == 0
    assert corrections.removed_objects(again()) == {number: "chair 1"}
    assert (tmp_path / "lift/fills" / f"{read_edits(tmp_path / 'lift')[0].fill}.npz").is_file()
    assert [ob for ob in bpy.data.objects if ob.get("instance_id") == number], "as a mesh of its own"
    registry.forget_all()
