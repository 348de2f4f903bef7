"""Eyes of instances and classes, in the view and in renders."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from plgs.plgs_blender.cameras import PATH
from plgs.plgs_blender.inspecting import looks
from plgs.plgs_blender.inspecting.selection import boxes_of, class_row_of, clouds_of, objects_by_key, row_of
from tiny_scene import CHAIR_ID


def seen(root: bpy.types.Collection) -> dict[str, int]:
    """How many points each cloud that is shown has left after its modifiers, and which boxes are shown."""
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    for cloud in clouds_of(root):
        opened = cloud.modifiers.get("Open room")
        if opened is not None:
            opened.show_viewport = False
    bpy.context.view_layer.update()
    clouds = {
        ob.name: len(ob.evaluated_get(graph).data.points)
        for ob in clouds_of(root)
        if ob.name != "Anchors" and not ob.hide_get()
    }
    boxes = {ob.name: 0 for ob in boxes_of(root).values() if not ob.hide_get()}
    return {name: count for name, count in clouds.items() if count} | boxes


def stored(lift: Path) -> np.ndarray:
    points = np.load(lift / "result" / "semantic_points.npz")
    return np.stack([points["class_id"], points["instance_id"]])


def test_an_instance_takes_its_box_points_and_anchors_with_it(root: bpy.types.Collection, lift: Path) -> None:
    before, row = seen(root), row_of(root, 1)
    row.visible = False
    after = seen(root)
    assert row.name in before and row.name not in after
    class_id, instance_id = stored(lift)
    left = sum(count for name, count in after.items())
    assert sum(before.values()) - left == (instance_id == 1).sum()
    anchors = next(cloud for cloud in clouds_of(root) if cloud.name == "Anchors")
    hidden = np.zeros(len(anchors.data.points), bool)
    anchors.data.attributes[looks.HIDDEN].data.foreach_get("value", hidden)
    assert np.array_equal(hidden, np.load(lift / "result" / "anchors.npz")["instance_id"] == 1)
    row.visible = True
    assert seen(root) == before
    assert not any(looks.HIDDEN in cloud.data.attributes for cloud in clouds_of(root))
    assert not any(cloud.modifiers.get(looks.MODIFIER) for cloud in clouds_of(root))


def test_a_class_takes_its_instances_with_it(root: bpy.types.Collection) -> None:
    before = seen(root)
    class_row_of(root, CHAIR_ID).visible = False
    assert set(before) - set(seen(root)) == {"chair", "chair 1"}
    looks.show_all(root)
    assert seen(root) == before and all(row.visible for row in root.plgs.classes)


def test_isolating_one_and_returning_to_what_was_shown(root: bpy.types.Collection, lift: Path) -> None:
    row_of(root, 2).visible = False
    before = seen(root)
    looks.isolate(root, 1)
    alone = seen(root)
    assert set(alone) == {"chair", "chair 1"} and alone["chair"] == (stored(lift)[1] == 1).sum()
    looks.isolate(root, 2)
    assert set(seen(root)) == {"cabinet", "cabinet 1"}, "alone even though its eye is closed"
    looks.isolate(root, 2)
    assert seen(root) == before and not row_of(root, 2).visible
    looks.isolate(root, 1)
    looks.show_all(root)
    assert root.plgs.isolated == 0 and {"chair 1", "cabinet 1"} <= set(seen(root))


def test_hidden_stays_hidden_in_the_file(root: bpy.types.Collection, tmp_path: Path) -> None:
    row_of(root, 1).visible = False
    before = seen(root)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    (again,) = [each for each in bpy.data.collections if each.name == "PLGS tiny room"]
    assert seen(again) == before
    assert not again.plgs.instances[0].visible


def test_cameras_that_are_off_are_as_small_as_blender_draws_them(root: bpy.types.Collection) -> None:
    ours = [ob for key, ob in objects_by_key(root).items() if key.startswith(("frame:", PATH)) and ob.type == "CAMERA"]
    smallest = ours[0].data.bl_rna.properties["display_size"].hard_min
    assert len(ours) > 1 and {round(ob.data.display_size, 6) for ob in ours} == {round(smallest, 6)}
    root.plgs.show_cameras = True
    assert min(ob.data.display_size for ob in ours) > 10 * smallest
