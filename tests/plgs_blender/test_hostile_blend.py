"""A lift.blend that somebody else put beside a lift: nothing in it is run, nothing elsewhere is written, and
odd values in it do no harm."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import pytest
from file_contents import contents
from plgs.engine.errors import PlgsError
from plgs.plgs_blender import lift_scene
from tiny_lift import write_tiny_lift

EXPECTED = (PlgsError, OSError)
ODD: list[Any] = [7, 1.5, True, [1, 2], {"a": 1}, "", "instance:x", "//", "/dev/zero", "\\\\host\\share", None]
"""None: the property is gone."""
KINDS = ("scenes", "collections", "objects", "cameras", "pointclouds", "meshes", "images", "node_groups")
OURS = ("plgs_", "frame", "class_id")


def write_hostile(blend: Path, marker: Path) -> None:
    """A file with a script that runs when it is opened, and with drivers, where scripts are allowed."""
    harm = f"open({str(marker)!r}, 'a').close()"
    text = bpy.data.texts.new("harm.py")
    text.write(harm)
    text.use_module = True
    ob = bpy.data.objects.new("driven", None)
    bpy.context.scene.collection.objects.link(ob)
    for expression in (harm, f"[each for each in [open({str(marker)!r}, 'a')]] and 1.0"):
        driver = ob.driver_add("location", 0 if expression == harm else 1).driver
        driver.type, driver.expression = "SCRIPTED", expression
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    marker.unlink(missing_ok=True)  # what it does while we make it
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


@pytest.mark.parametrize("are_scripts_allowed", [False, True])
def test_nothing_in_it_is_run(lift: Path, tmp_path: Path, are_scripts_allowed: bool) -> None:
    blend, marker = tmp_path / "lift.blend", tmp_path / "marker"
    write_hostile(blend, marker)
    settings = bpy.context.preferences.filepaths
    before = settings.use_scripts_auto_execute
    settings.use_scripts_auto_execute = are_scripts_allowed
    try:
        lift_scene.save_lift(lift, blend)
        bpy.context.scene.frame_set(3)
        bpy.context.view_layer.update()
    finally:
        settings.use_scripts_auto_execute = before
    assert not marker.exists()
    assert len(lift_scene.lifts_in(bpy.context.scene)) == 1 and "driven" in bpy.data.objects


def fifo(path: Path) -> None:
    os.mkfifo(path)


def folder(path: Path) -> None:
    path.mkdir()


def noise(path: Path) -> None:
    path.write_bytes(b"BLENDER-v405" + bytes(range(256)))


def link_to_a_text(path: Path) -> None:
    (path.parent / "precious").write_text("precious")
    path.symlink_to(path.parent / "precious")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no FIFOs")
@pytest.mark.parametrize("make", [fifo, folder, noise, link_to_a_text])
def test_what_is_no_blend_is_one_line(lift: Path, tmp_path: Path, make: Callable[[Path], None]) -> None:
    """Blender would wait for ever for whoever writes into the FIFO."""
    blend = tmp_path / "lift.blend"
    make(blend)
    before, there = contents(), sorted(tmp_path.rglob("*"))
    with pytest.raises(PlgsError) as error:
        lift_scene.save_lift(lift, blend)
    assert "\n" not in str(error.value) and "lift.blend" in str(error.value)
    assert contents() == before and sorted(tmp_path.rglob("*")) == there


def test_a_link_is_replaced_and_what_it_leads_to_stays(lift: Path, tmp_path: Path) -> None:
    theirs, blend = tmp_path / "theirs.blend", tmp_path / "lift.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(theirs))
    before = theirs.read_bytes()
    blend.symlink_to(theirs)
    lift_scene.save_lift(lift, blend)
    assert theirs.read_bytes() == before and not blend.is_symlink()


@pytest.mark.parametrize("every", [6, pytest.param(1, marks=pytest.mark.slow)], ids=["some", "all"])
def test_odd_custom_properties(tmp_path: Path, every: int) -> None:
    """Each of ours, on one block of each kind, with other values: none of Python's own errors comes of it."""
    small, placed = write_tiny_lift(tmp_path / "lift", frames=5, size=(16, 12)).path, tmp_path / "file.blend"
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    lift_scene.place_lift(small, bpy.context.scene)
    bpy.ops.wm.save_as_mainfile(filepath=str(placed))
    found = {
        (kind, name): block.name
        for kind in KINDS
        for block in getattr(bpy.data, kind)
        for name in block.keys()
        if name.startswith(OURS)
    }
    assert len(found) > 10
    for number, ((kind, name), block) in enumerate(found.items()):
        for value in ODD[number % every :: every]:
            bpy.ops.wm.open_mainfile(filepath=str(placed))
            spoilt, scene = getattr(bpy.data, kind)[block], bpy.context.scene
            if value is None:
                del spoilt[name]
            else:
                spoilt[name] = value
            for act in (lift_scene.place_lift, lift_scene.place_passes_anew):
                try:
                    act(small, scene)
                except EXPECTED as error:
                    assert "\n" not in str(error)
