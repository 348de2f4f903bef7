"""The lists that a lift's collection carries."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np
import pytest
from plgs.engine.result_files import MatchedSegment
from plgs.plgs_blender import lift_scene
from plgs.plgs_blender.inspecting.lists import _fill_instances, best_view, fill_masks
from plgs.plgs_blender.owned import lifts_in
from plgs.plgs_blender.results import reading_result, result_of
from tiny_lift import CABINET_NAME, CHAIR_NAME
from tiny_scene import CHAIR_ID


def test_they_say_the_same_as_the_result(root: bpy.types.Collection, lift: Path) -> None:
    told = json.loads((lift / "result" / "instances.json").read_text())["instances"]
    for row, entry in zip(root.plgs.instances, told, strict=True):
        assert (row.instance_id, row.name, row.class_id) == (entry["id"], entry["name"], entry["class_id"])
        assert (row.points, row.views, row.score) == (entry["points"], entry["views"], pytest.approx(entry["score"]))
        assert [round(255 * channel) for channel in row.colour] == entry["colour"]
        assert [mask.frame for mask in row.masks] == [each["frame"] for each in entry["segments"]]
        assert [mask.segment for mask in row.masks] == [each["segment_id"] for each in entry["segments"]]
        first, stored = row.masks[0], entry["segments"][0]
        assert (first.class_name, first.pixels) == (entry["class_name"], stored["pixels"])
        assert first.reason == "75 % agreement"
        assert list(first.rectangle) == pytest.approx(stored["rectangle"])
    points = np.load(lift / "result" / "semantic_points.npz")["class_id"]
    assert {row.class_id: row.points for row in root.plgs.classes} == {
        int(each): int((points == each).sum()) for each in np.unique(points)
    }
    assert {row.name for row in root.plgs.classes if row.is_thing} == {"chair", "cabinet"}
    assert all(row.visible for row in (*root.plgs.instances, *root.plgs.classes))
    assert root.plgs.instance_index == -1


def test_they_stay_in_the_file_even_if_a_script_placed_it(lift: Path, tmp_path: Path, plgs: ModuleType) -> None:
    assert not hasattr(bpy.types.Collection, "plgs")
    lift_scene.save_lift(lift, tmp_path / "lift.blend")
    assert not hasattr(bpy.types.Collection, "plgs"), "a script that places a lift switches nothing on"
    plgs.register()
    try:
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "lift.blend"))
        (root,) = lifts_in(bpy.context.scene)
        assert [row.name for row in root.plgs.instances] == [CHAIR_NAME, CABINET_NAME]
        assert all(len(row.masks) for row in root.plgs.instances)
    finally:
        plgs.unregister()


def test_another_split_with_as_many_masks_lists_its_own(root: bpy.types.Collection, lift: Path) -> None:
    result = result_of(reading_result(lift))
    first, *others = result.instances
    moved = replace(first, score=0.125, segments=tuple(replace(each, segment_id=77) for each in first.segments))
    _fill_instances(root.plgs.instances, [moved, *others])
    fill_masks(root, [moved, *others], result.classes)
    row, other = root.plgs.instances[0], root.plgs.instances[1]
    assert row.score == 0.125 and {mask.segment for mask in row.masks} == {77}
    assert {mask.segment for mask in other.masks} == {each.segment_id for each in others[0].segments}


def mask(share: float, *rectangle: float) -> MatchedSegment:
    return MatchedSegment("0001", 1, CHAIR_ID, 0.9, None, 0.5, 100, share, rectangle)  # type: ignore[arg-type]


def test_the_best_view_sees_much_and_all_of_it() -> None:
    small, large, cut = mask(0.05, 0.4, 0.4, 0.6, 0.6), mask(0.2, 0.2, 0.2, 0.8, 0.8), mask(0.3, 0.0, 0.2, 0.7, 0.9)
    assert best_view([small, large, cut]) == 1
    assert best_view([small, cut]) == 1, "half of what is cut off is still more"
    assert best_view([]) == best_view([mask(0.0, 0.0, 0.0, 0.0, 0.0)]) == -1
