"""A result is placed in parts, and between two of them the user may change everything."""

from __future__ import annotations

from pathlib import Path

import bpy
import pytest
from plgs.engine.job import LiftFolder
from plgs.plgs_blender import lift_scene
from plgs.plgs_blender.owned import LIFT
from plgs.plgs_blender.running import lifts


def test_parts_and_the_whole_are_the_same(lift: Path) -> None:
    scene = bpy.context.scene
    placed = lift_scene.place_room(lift_scene.result_of(lift_scene.reading_lift(lift)), scene)
    assert "Gaussians" not in bpy.data.objects
    lift_scene.result_of(placed.rest)
    in_parts = sorted(ob.name for ob in bpy.data.objects)
    assert lift_scene.place_lift(lift, scene)[LIFT] == placed.at.lift
    assert sorted(ob.name for ob in bpy.data.objects) == in_parts


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_a_lift_that_is_removed_between_parts_stays_removed(lift: Path, parts: int) -> None:
    scene = bpy.context.scene
    placed = lift_scene.place_room(lift_scene.result_of(lift_scene.reading_lift(lift)), scene)
    for _ in range(parts):
        next(placed.rest)
    root, _ = placed.at.find() or pytest.fail("it is there")
    for collection in [*root.children_recursive, root]:
        bpy.data.collections.remove(collection)
    lift_scene.result_of(placed.rest)
    assert placed.at.find() is None


def test_a_scene_that_no_longer_wants_it_gets_nothing(lift: Path) -> None:
    asked: list[str] = []

    def is_wanted(scene: bpy.types.Scene) -> bool:
        asked.append(scene.name)
        return False

    showing = lifts.showing_lift(bpy.context.scene, LiftFolder.open(lift), is_wanted)
    before = {ob.name for ob in bpy.data.objects}
    assert lift_scene.result_of(showing) is None
    assert asked == [bpy.context.scene.name] and {ob.name for ob in bpy.data.objects} == before
