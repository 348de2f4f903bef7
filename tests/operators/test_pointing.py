"""Keys that act on the selected objects of a lift, and leave Blender's own objects to Blender."""

from pathlib import Path

import bpy
import pytest
from plgs.engine.corrections import read_edits
from plgs.engine.errors import PlgsError
from plgs.operators import corrections as correcting
from plgs.operators import pointing
from plgs.plgs_blender import corrections
from plgs.plgs_blender.inspecting.selection import boxes_of, clouds_of

CHAIR, CABINET = 1, 2


@pytest.fixture(autouse=True)
def _in_a_view(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blender without a window has no area, which the keys ask for."""
    monkeypatch.setattr(pointing.InView, "poll", classmethod(lambda cls, context: True))


def choose(active: bpy.types.Object, *selected: bpy.types.Object) -> None:
    for ob in bpy.context.view_layer.objects:
        if ob in selected:
            ob.hide_set(False)
        ob.select_set(ob in selected)
    bpy.context.view_layer.objects.active = active


def own(name: str) -> bpy.types.Object:
    ob = bpy.data.objects.new(name, bpy.data.meshes.new(name))
    bpy.context.scene.collection.objects.link(ob)
    bpy.context.view_layer.update()  # selected_objects has what the view layer knows to be visible
    return ob


def test_the_delete_key_keeps_cameras_of_the_lift(placed: bpy.types.Collection, mine: Path) -> None:
    own("chair 1 of mine")
    choose(boxes_of(placed)[CHAIR], *bpy.context.view_layer.objects)
    cameras = sum(ob.type == "CAMERA" for ob in placed.all_objects)
    assert any(cloud.get("class") == "chair" for cloud in clouds_of(placed)), "deleting the chair removes its cloud"
    assert bpy.ops.plgs.delete_selected(way="DISSOLVE") == {"FINISHED"}
    assert not boxes_of(placed) and "chair 1 of mine" not in bpy.data.objects
    assert [edit.kind for edit in read_edits(mine)] == ["delete", "delete"]
    assert sum(ob.type == "CAMERA" for ob in placed.all_objects) == cameras
    assert not any(cloud.get("class") == "chair" for cloud in clouds_of(placed)) and clouds_of(placed)


def test_the_x_key_hides_selected_objects_until_show_all(placed: bpy.types.Collection, mine: Path) -> None:
    cube, boxes = own("Cube"), boxes_of(placed)
    choose(boxes[CHAIR], boxes[CHAIR], cube)
    assert bpy.ops.plgs.delete_selected() == {"FINISHED"}
    assert cube.hide_get() and boxes[CHAIR].hide_get() and not read_edits(mine)
    assert [row.visible for row in placed.plgs.instances] == [False, True]
    bpy.ops.plgs.show_all()
    assert all(row.visible for row in placed.plgs.instances)


def test_the_x_key_removes_selected_objects_with_an_engine(
    placed: bpy.types.Collection, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That the engine does it to its end, is shown in test_corrections."""
    asked: list[tuple[str, list[int]]] = []
    monkeypatch.setattr(correcting, "remove_objects", lambda root, chosen: asked.append((root.name, chosen)))
    choose(boxes_of(placed)[CHAIR], boxes_of(placed)[CHAIR])
    assert bpy.ops.plgs.delete_selected(way="REMOVE") == {"FINISHED"} and asked == [(placed.name, [CHAIR])]


@pytest.mark.parametrize("shows_boxes", [True, False])
def test_keys_without_a_selected_box_do_what_blender_does(placed: bpy.types.Collection, shows_boxes: bool) -> None:
    placed.plgs.show_boxes = shows_boxes
    cube, box = own("Cube"), boxes_of(placed)[CHAIR]
    choose(box, cube)
    for key in (bpy.ops.plgs.delete_selected, bpy.ops.plgs.rename_selected):
        assert not key.poll()
    choose(box, box)
    assert bpy.ops.plgs.delete_selected.poll() and bpy.ops.plgs.rename_selected.poll()
    assert bpy.ops.plgs.delete_selected(way="DISSOLVE") == {"FINISHED"} and "Cube" in bpy.data.objects
    assert [*boxes_of(placed)] == [CABINET]


def test_keys_leave_a_copied_box_to_blender(placed: bpy.types.Collection) -> None:
    copy = boxes_of(placed)[CHAIR].copy()
    bpy.context.scene.collection.objects.link(copy)
    choose(copy, copy)
    assert not bpy.ops.plgs.delete_selected.poll() and not bpy.ops.plgs.rename_selected.poll()
    choose(boxes_of(placed)[CABINET], copy, boxes_of(placed)[CABINET])
    name = copy.name
    assert bpy.ops.plgs.delete_selected(way="DISSOLVE") == {"FINISHED"}
    assert [*boxes_of(placed)] == [CHAIR] and name not in bpy.data.objects


@pytest.mark.parametrize("chosen", [(CHAIR, CABINET), (CABINET,)])
def test_undo_works_after_an_error(
    placed: bpy.types.Collection, mine: Path, chosen: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full when the cabinet is deleted."""
    delete = corrections.making.delete

    def one_only(state: object, number: int) -> object:
        if number == CABINET:
            raise PlgsError("made-up", "the disk is full", "corrections.json", "Make room.")
        return delete(state, number)

    monkeypatch.setattr(corrections.making, "delete", one_only)
    bpy.ops.ed.undo_push(message="placed")
    name, own_name = placed.name, own("Cube").name
    bpy.ops.ed.undo_push(message="cube")
    boxes = boxes_of(placed)
    choose(boxes[chosen[0]], *(boxes[number] for number in chosen))
    with pytest.raises(RuntimeError, match="[Tt]he disk is full"):
        bpy.ops.plgs.delete_selected("EXEC_DEFAULT", True, way="DISSOLVE")  # with its undo step, as a key's
    bpy.ops.ed.undo()
    assert sorted(boxes_of(bpy.data.collections[name])) == [CHAIR, CABINET]
    assert all(edit.undone for edit in read_edits(mine)) and len(read_edits(mine)) == len(chosen) - 1
    is_own_step = len(chosen) == 1  # nothing was deleted, so that undo takes back the step before it
    assert (own_name in bpy.data.objects) != is_own_step
