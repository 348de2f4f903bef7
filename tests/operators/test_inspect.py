"""Inspecting a lift from a script, with the same arguments as from the buttons."""

import shutil
from dataclasses import replace
from pathlib import Path

import bpy
import pytest
from plgs.plgs_blender.inspecting.lists import fill_not_shown
from plgs.plgs_blender.lift_scene import place_lift
from plgs.plgs_blender.passes import passes_scene_of
from plgs.plgs_blender.results import read_result
from tiny_lift import CABINET_NAME, CHAIR_NAME

from tests.raises_key import worded

NAMES = (
    "select_instance", "select_class", "toggle_instance_visibility", "isolate_instance",
    "show_all", "show_as", "frame_instance", "go_to_best_view", "go_to_mask", "go_to_frame",
)  # fmt: skip


@pytest.fixture
def root(lift: Path) -> bpy.types.Collection:
    placed = place_lift(lift, bpy.context.scene)
    bpy.context.view_layer.update()
    return placed


@pytest.mark.parametrize("name", NAMES)
def test_every_inspect_button_without_a_lift_says_why_it_is_disabled(name: str) -> None:
    with pytest.raises(RuntimeError, match="no lift result yet"):
        getattr(bpy.ops.plgs, name)()


def test_buttons_are_grey_while_nothing_is_chosen_and_the_matte_without_passes(root: bpy.types.Collection) -> None:
    several = ("merge_instances", "reclass_instances", "accept_instances", "make_objects", "key_visibility")
    buttons = [getattr(bpy.ops.plgs, name) for name in ("isolate_instance", *several)]
    mattes = bpy.ops.plgs.matte_instance, bpy.ops.plgs.matte_class
    with bpy.context.temp_override(plgs_panel=bpy.context.scene.plgs):
        assert not any(each.poll() for each in buttons)
    bpy.ops.plgs.select_instance(instance=1)
    with bpy.context.temp_override(plgs_panel=bpy.context.scene.plgs):
        assert all(each.poll() for each in (*buttons, *mattes))
    bpy.data.scenes.remove(passes_scene_of(bpy.context.scene))  # type: ignore[arg-type]
    with bpy.context.temp_override(plgs_panel=bpy.context.scene.plgs):
        assert not any(each.poll() for each in mattes)


@pytest.mark.parametrize("argument", ["", "PLGS tiny room", "folder"])
def test_select_instance_accepts_a_lifts_name_or_folder(root: bpy.types.Collection, lift: Path, argument: str) -> None:
    named = str(lift) if argument == "folder" else argument
    assert bpy.ops.plgs.select_instance(instance=2, lift=named) == {"FINISHED"}
    assert bpy.context.active_object.name == f"{CABINET_NAME} box"
    with pytest.raises(RuntimeError, match=worded("lift-elsewhere")):
        bpy.ops.plgs.select_instance(instance=2, lift="another")


def test_instance_zero_means_the_one_selected_in_the_list(root: bpy.types.Collection) -> None:
    with pytest.raises(RuntimeError, match=worded("no-selection")):
        bpy.ops.plgs.isolate_instance()
    bpy.ops.plgs.select_instance(instance=1)
    bpy.ops.plgs.isolate_instance()
    assert root.plgs.isolated == 1
    bpy.ops.plgs.isolate_instance()
    assert root.plgs.isolated == 0
    with pytest.raises(RuntimeError, match="no instance 9"):
        bpy.ops.plgs.isolate_instance(instance=9)


def test_boxes_are_coloured_by_class_or_by_instance(root: bpy.types.Collection) -> None:
    chair, cloud = bpy.data.objects[f"{CHAIR_NAME} box"], bpy.data.objects["chair points"]
    own = tuple(chair.color)
    root.plgs.look = "CLASSES"
    assert tuple(chair.color) == pytest.approx(tuple(cloud.color)) != pytest.approx(own)
    root.plgs.look = "INSTANCES"
    assert tuple(chair.color) == pytest.approx(own)
    root.plgs.instances[0].colour = (1.0, 0.0, 0.0)
    assert tuple(chair.color) == pytest.approx((1.0, 0.0, 0.0, 1.0)), "a colour chosen in the list is the box's"


def test_views_and_masks_of_an_instance_are_shown(root: bpy.types.Collection) -> None:
    row = root.plgs.instances[0]
    bpy.ops.plgs.go_to_best_view(instance=1)
    best = row.masks[row.best_mask].frame
    assert bpy.context.scene.camera["frame"] == best
    other = next(mask for mask in row.masks if mask.frame != best)
    bpy.ops.plgs.go_to_mask(instance=1, frame=other.frame, segment=other.segment)
    assert bpy.context.scene.camera["frame"] == other.frame
    with pytest.raises(RuntimeError, match=worded("no-such-mask")):
        bpy.ops.plgs.go_to_mask(instance=1, frame="nowhere")


def test_objects_missing_from_a_lift_are_listed(lift: Path) -> None:
    """A class that near masks name and the passes lack: its row goes to the frame."""
    result = replace(read_result(lift), not_shown=(("sink: seen from near in 4 views", "0002"),))
    root = place_lift(lift, bpy.context.scene)
    fill_not_shown(root, result)
    assert [(row.name, row.frame) for row in root.plgs.not_shown] == [("sink: seen from near in 4 views", "0002")]
    bpy.ops.plgs.go_to_frame(frame=root.plgs.not_shown[0].frame)
    assert bpy.context.scene.camera["frame"] == "0002"
    with pytest.raises(RuntimeError):
        bpy.ops.plgs.go_to_frame(frame="nowhere")


def test_a_gaussians_file_without_splats_adds_no_object(root: bpy.types.Collection, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="gaussians.ply"):
        bpy.ops.plgs.show_as(kind="SPLATS")
    result = Path(shutil.copytree(Path(root["plgs_lift_folder"]) / "result", tmp_path / "lift" / "result"))
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (result / "gaussians.ply").write_text(head + "0 0 0\n")
    root["plgs_lift_folder"] = str(tmp_path / "lift")
    before = (len(bpy.data.objects), len(bpy.data.meshes))
    with pytest.raises(RuntimeError, match=worded("no-splats")):
        bpy.ops.plgs.show_as(kind="SPLATS")
    assert (len(bpy.data.objects), len(bpy.data.meshes)) == before
