"""What blender.md and corrections.md promise of Blender: its operators on a lift that the engine made."""

import json
from pathlib import Path

import bpy
import cv2
import pytest
from plgs.plgs_blender.inspecting.selection import boxes_of
from plgs.plgs_blender.owned import lifts_in

import engine
from tests.doors.terminal import Terminal

LIFT = "lifts/demo"


@pytest.fixture
def shown(terminal: Terminal, extension: None) -> Path:
    """A lift that an open file shows."""
    lift = terminal.folder / LIFT
    assert bpy.ops.plgs.open_lift(directory=str(lift)) == {"FINISHED"}
    return lift


def row_of(class_name: str) -> bpy.types.PropertyGroup:
    """The list's row of the only object of a class."""
    [row] = [row for row in lifts_in(bpy.context.scene)[0].plgs.instances if row.class_name == class_name]
    return row


def test_an_open_file_shows_edits_from_the_command_line_after_open_lift(terminal: Terminal, shown: Path) -> None:
    chair, cabinet = row_of("chair").instance_id, row_of("cabinet").instance_id
    terminal.run(f'.venv/bin/python -m engine correct {LIFT} rename {chair} "Anna\'s sofa"')
    terminal.run(f".venv/bin/python -m engine correct {LIFT} delete {cabinet}")
    assert row_of("chair").name == "chair 1"
    bpy.ops.plgs.open_lift(directory=str(shown))
    assert row_of("chair").name == "Anna's sofa" and [*boxes_of(lifts_in(bpy.context.scene)[0])] == [chair]


def test_making_an_object_hides_it_in_the_lift_and_its_eye_shows_it_again(shown: Path) -> None:
    chair = row_of("chair").instance_id
    assert bpy.ops.plgs.make_objects(instances=str(chair)) == {"FINISHED"}
    assert not row_of("chair").visible and row_of("cabinet").visible
    bpy.ops.plgs.toggle_instance_visibility(instance=chair)
    assert row_of("chair").visible and "chair 1" in bpy.data.collections


def test_points_assigned_to_a_class_belong_to_no_object(shown: Path) -> None:
    chair, before = row_of("chair").instance_id, engine.read_lift(shown).points
    box = boxes_of(lifts_in(bpy.context.scene)[0])[chair]
    region = bpy.data.objects.new("region", box.data)
    region.matrix_world = box.matrix_world
    bpy.context.collection.objects.link(region)
    bpy.context.view_layer.update()
    assert bpy.ops.plgs.assign_points(to="CLASS", class_name="wall", region="region") == {"FINISHED"}
    after = engine.read_lift(shown).points
    lost = (before.instance_id == chair) & (after.instance_id != chair)
    assert lost.any() and (after.instance_id[lost] == 0).all()
    assert {*after.class_id[lost].tolist()} == {1}


def test_next_uncertain_frame_shows_frames_without_doubt_last(shown: Path) -> None:
    path = shown / "result/metrics.json"
    metrics = json.loads(path.read_text())
    drawn = {"0001": 0.2, "0005": 0.7, "0003": 0.4}
    metrics["masks_as_judges"]["doubt"] = drawn
    path.write_text(json.dumps(metrics))
    visited = []
    for _ in range(6):
        assert bpy.ops.plgs.next_uncertain_frame() == {"FINISHED"}
        visited.append(bpy.context.scene.camera["frame"])
    assert visited[:3] == ["0005", "0003", "0001"] and sorted(visited) == [f"{number:04d}" for number in range(6)]


def test_boxes_names_and_cameras_do_not_appear_in_renders(shown: Path) -> None:
    objects = [*lifts_in(bpy.context.scene)[0].all_objects]
    boxes = [ob for ob in objects if ob.type in ("MESH", "EMPTY", "FONT") and ob.name.endswith(" box")]
    assert len(boxes) == 2 and all(ob.hide_render for ob in boxes)
    assert any(ob.type == "CAMERA" for ob in objects) and not any(ob.type == "FONT" for ob in objects)


def brightness(picture: Path) -> float:
    """The mean of what Cycles renders of the open scene, 0 to 255."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.render.filepath = "CYCLES", 4, str(picture)
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 32, 24, 100
    bpy.ops.render.render(write_still=True)
    return float(cv2.imread(str(picture)).mean())


def test_lights_change_the_surface_only_in_the_mode_lit(terminal: Terminal, extension: None) -> None:
    lift, picture = terminal.folder / LIFT, terminal.folder / "render.png"
    terminal.run(f".venv/bin/python -m engine export {LIFT} --to surface -o {LIFT}/exports/surface")
    bpy.ops.plgs.open_lift(directory=str(lift))
    scene, root = bpy.context.scene, lifts_in(bpy.context.scene)[0]
    scene.camera = next(ob for ob in root.all_objects if ob.get("frame") == "0001")
    for kind in ("POINTS", "SPLATS", "SURFACE"):
        assert bpy.ops.plgs.show_as(kind=kind) == {"FINISHED"}
        assert brightness(picture) > 20, kind
    root.plgs.lit = True
    assert brightness(picture) < 1, "there is no light"
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy = 10
    scene.collection.objects.link(sun)
    assert brightness(picture) > 5
