"""A box, its row and its points are selected together."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest
from plgs.engine.corrections import read_edits
from plgs.plgs_blender import corrections, lift_scene
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.import_scene import place_scene
from plgs.plgs_blender.inspecting import highlight, selection
from plgs.plgs_blender.inspecting.looks import lifts_shown
from plgs.plgs_blender.inspecting.selection import active_lift, boxes_of, find_lift, objects_by_key
from plgs.plgs_blender.owned import lifts_in
from tiny_lift import write_tiny_lift
from tiny_scene import write_tiny_scene

from tests.raises_key import raises_key


def pick(ob: bpy.types.Object) -> None:
    """What a click in the view does: this object alone is selected and active."""
    ob.hide_set(False)
    for other in bpy.context.view_layer.objects:
        other.select_set(other == ob)
    bpy.context.view_layer.objects.active = ob


def selected() -> list[str]:
    return [ob.name for ob in bpy.context.view_layer.objects if ob.select_get()]


def follow() -> None:
    selection.follow_selected(bpy.context.scene, bpy.context.view_layer)


def test_a_box_that_is_clicked_is_selected_in_the_list(root: bpy.types.Collection) -> None:
    boxes = boxes_of(root)
    for number in (2, 1):
        pick(boxes[number])
        follow()
        assert root.plgs.instances[root.plgs.instance_index].instance_id == number
        assert selected() == [boxes[number].name], "following changes no selection"
        assert [key for key, box in boxes.items() if not box.hide_get()] == [number], "only its box is seen"
    pick(bpy.data.objects["Overview"])
    follow()
    assert root.plgs.instance_index == -1 and all(box.hide_get() for box in boxes.values())
    assert selected() == ["Overview"]
    root.plgs.show_boxes = True
    assert not any(box.hide_get() for box in boxes.values())


def test_a_row_of_the_list_selects_only_its_box(root: bpy.types.Collection) -> None:
    pick(bpy.data.objects["Overview"])
    root.plgs.instance_index = 1
    box = boxes_of(root)[root.plgs.instances[1].instance_id]
    assert selected() == [box.name] and bpy.context.view_layer.objects.active == box
    selection.select_instance(root, 1, bpy.context.view_layer)
    assert selected() == [boxes_of(root)[1].name] and root.plgs.instance_index == 0


def test_several_objects_are_selected_one_after_the_other(root: bpy.types.Collection) -> None:
    layer, boxes = bpy.context.view_layer, boxes_of(root)
    for number, extend in ((1, False), (2, True)):
        selection.select_instance(root, number, layer, extend=extend)
    assert selection.selected_instances(root, layer) == [2, 1] and not any(box.hide_get() for box in boxes.values())
    selection.select_instance(root, 2, layer, extend=True)
    assert selection.selected_instances(root, layer) == [1]


def test_a_hidden_object_is_selected_only_in_the_list(root: bpy.types.Collection) -> None:
    boxes = boxes_of(root)
    pick(bpy.data.objects["Overview"])
    root.plgs.instances[0].visible = False
    root.plgs.instance_index = 0
    bpy.data.objects.remove(boxes[2])
    assert selected() == ["Overview"]
    follow()
    assert root.plgs.instance_index == 0, "what cannot be selected in the view stays the list's"
    root.plgs.instance_index = 1
    assert selected() == ["Overview"]
    follow()
    assert root.plgs.instance_index == 1
    with raises_key("no-object"):
        selection.select_instance(root, 7, bpy.context.view_layer)


def test_a_renamed_box_is_found_after_undo(root: bpy.types.Collection) -> None:
    bpy.ops.ed.undo_push(message="placed")
    pick(boxes_of(root)[2])
    bpy.ops.ed.undo_push(message="picked")
    boxes_of(root)[2].name = "my cupboard"
    bpy.ops.ed.undo_push(message="renamed")
    bpy.ops.ed.undo()
    (again,) = lifts_in(bpy.context.scene)
    follow()
    assert again.plgs.instances[again.plgs.instance_index].instance_id == 2
    assert selection.selected_instance(again, bpy.context.view_layer.objects.active) == 2


def test_selecting_in_one_lift_leaves_the_other_lift_alone(root: bpy.types.Collection, tmp_path: Path) -> None:
    other = lift_scene.place_lift(write_tiny_lift(tmp_path / "lift", frames=4, bake=False).path, bpy.context.scene)
    scene = bpy.context.scene
    pick(boxes_of(other)[2])
    follow()
    assert (root.plgs.instance_index, other.plgs.instance_index) == (-1, 1)
    assert find_lift(scene, active=boxes_of(other)[1]) == other and find_lift(scene) == other
    assert find_lift(scene, other.name) == other and find_lift(scene, str(tmp_path / "lift")) == other
    selection.choose_lift(root, scene, bpy.context.view_layer)
    assert active_lift(scene, None) == root and lifts_shown(scene, bpy.context.view_layer) == [root, other]
    with raises_key("lift-elsewhere"):
        find_lift(scene, str(tmp_path))


def test_points_of_the_selected_instance_are_highlighted(root: bpy.types.Collection, lift: Path) -> None:
    stored = np.load(lift / "result" / "semantic_points.npz")
    anchors = np.load(lift / "result" / "anchors.npz")
    mine = highlight.highlight_of(root, 1, lambda cloud: cloud.name != "Anchors")
    assert len(mine.xyz) == (stored["instance_id"] == 1).sum() and mine.radius > 0.0
    assert np.allclose(np.sort(mine.xyz, axis=0), np.sort(stored["xyz"][stored["instance_id"] == 1], axis=0))
    assert highlight.highlight_of(root, 1, lambda cloud: cloud.name != "Anchors") is mine, "read once"
    both = highlight.highlight_of(root, 1, lambda cloud: True)
    assert len(both.xyz) == len(mine.xyz) + (anchors["instance_id"] == 1).sum()
    assert len(highlight.highlight_of(root, 99, lambda cloud: True).xyz) == 0


def test_objects_moved_to_another_collection_still_belong_to_the_lift(root: bpy.types.Collection) -> None:
    mine = bpy.data.collections.new("mine")
    bpy.context.scene.collection.children.link(mine)
    for ob in (boxes_of(root)[1], bpy.data.objects["0003"], bpy.data.objects["wall points"]):
        for collection in ob.users_collection:
            collection.objects.unlink(ob)
        mine.objects.link(ob)
    assert {"instance:1", "frame:0003"} <= set(objects_by_key(root))
    selection.select_instance(root, 1, bpy.context.view_layer)
    assert selected() == [boxes_of(root)[1].name]


def test_a_lift_with_a_result_is_preferred_to_an_imported_scene(extension: None, lift: Path, tmp_path: Path) -> None:
    imported = place_scene(ChosenScene(write_tiny_scene(tmp_path / "other", frames=4)), bpy.context.scene)
    placed = lift_scene.place_lift(lift, bpy.context.scene)
    assert lifts_in(bpy.context.scene) == [imported, placed]
    assert active_lift(bpy.context.scene, None) == placed
    camera = next(ob for ob in imported.all_objects)
    assert active_lift(bpy.context.scene, camera) == imported


@pytest.mark.parametrize("name", ["sofa 1.001", "沙" * 30, "chair", "Throne"])
def test_blenders_numbering_is_not_taken_for_a_rename(lift: Path, tmp_path: Path, extension: None, name: str) -> None:
    mine = Path(shutil.copytree(lift, tmp_path / "mine"))
    root = lift_scene.place_lift(mine, bpy.context.scene)
    assert bpy.data.objects.new("chair box", None), "a name that is taken"
    corrections.rename(root, 1, name)
    lift_scene.place_lift(mine, bpy.context.scene)
    pick(boxes_of(root)[1])
    corrections.accept(root, [2])
    for _ in range(2):
        selection.follow_name()
    assert [edit.kind for edit in read_edits(mine)] == ["rename", "accept"] and root.plgs.instances[0].name == name


def test_renaming_a_box_keeps_the_name_without_blenders_number(lift: Path, tmp_path: Path, extension: None) -> None:
    mine = Path(shutil.copytree(lift, tmp_path / "mine"))
    root = lift_scene.place_lift(mine, bpy.context.scene)
    for typed, kept in (("chair", "chair"), ("bench.002", "bench.002")):
        pick(boxes_of(root)[1])
        boxes_of(root)[1].name = typed
        for _ in range(2):
            selection.follow_name()
        assert root.plgs.instances[0].name == kept
    assert [edit.name for edit in read_edits(mine)] == ["chair", "bench.002"]
