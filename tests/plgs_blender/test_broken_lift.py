"""A lift, a scene or a lift.blend of somebody else, or damaged, changes nothing in the open file, and runs nothing."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
from blender_helpers import contents
from plgs.engine.errors import PlgsError
from plgs.engine.result_files import read_instances
from plgs.plgs_blender import lift_scene
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.import_scene import place_scene
from plgs.plgs_blender.inspecting import views
from plgs.plgs_blender.inspecting.lists import registered
from plgs.plgs_blender.inspecting.selection import boxes_of
from plgs.plgs_blender.results import read_result, reading_instances, result_of
from plgs.plgs_blender.viewport import all_views
from tiny_lift import mend_manifest, write_tiny_lift

from tests.raises_key import raises_key


@pytest.mark.parametrize("content", [b"\0", b"v/1\x01\2\0\0\0channels\0chlist"])
def test_a_lift_with_broken_passes_changes_nothing_in_blender(tmp_path: Path, content: bytes) -> None:
    lift = write_tiny_lift(tmp_path / "lift", frames=10).path
    path = next((lift / "result" / "passes").iterdir())
    path.write_bytes(content.ljust(path.stat().st_size, b"\0"))
    before = contents()
    with raises_key(f"file-changed {path.name}"):
        lift_scene.place_lift(lift, bpy.context.scene)
    assert contents() == before


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("id", -1),
        ("id", 2**31),
        ("id", 2),
        ("id", 65536),
        ("class_id", 2**31 - 2),
        ("id", float("inf")),
        ("points", 2**40),
        ("colour", [256, 0, 0]),
        ("score", float("nan")),
        ("size", [1.0, 1.0, 3e38]),
        ("name", "\ud800"),
        ("segments", [7]),
        ("segments", ["x"]),
    ],
)
def test_a_lift_with_absurd_instances_is_not_placed(lift: Path, tmp_path: Path, name: str, value: object) -> None:
    content = json.loads((lift / "result" / "instances.json").read_text())
    content["instances"][0][name] = value
    with_instances(lift, tmp_path, json.dumps(content))


@pytest.mark.parametrize(
    ("xyz", "message"),
    [
        (lambda xyz: np.full_like(xyz, 3e38), "positions semantic_points.npz"),
        (lambda xyz: np.zeros((30_000_000, 3), np.float32), "array-too-large"),
    ],
    ids=["absurd", "gigabytes"],
)
def test_a_lift_with_bad_positions_is_not_placed(lift: Path, tmp_path: Path, xyz: Callable, message: str) -> None:
    shutil.copytree(lift, tmp_path / "lift")
    path = tmp_path / "lift" / "result" / "semantic_points.npz"
    points = dict(np.load(path))
    np.savez_compressed(path, **points | {"xyz": xyz(points["xyz"])})
    refuses(tmp_path / "lift", message)


ROT = {
    "deflate": lambda data: data[:200] + bytes(byte ^ 0x5A for byte in data[200:300]) + data[300:],
    "the end": lambda data: data[: len(data) // 2] + bytes(len(data) - len(data) // 2),
    "all": lambda data: bytes(len(data)),
}


@pytest.mark.parametrize("spoil", ROT.values(), ids=ROT)
@pytest.mark.parametrize("name", ["semantic_points.npz", "anchors.npz", "instances.json", "passes/0004.exr"])
def test_corrupt_lifts_are_not_placed(lift: Path, tmp_path: Path, name: str, spoil: Callable[[bytes], bytes]) -> None:
    """As a disk leaves it, found by its checksum; or with a manifest that lists the rotten bytes."""
    shutil.copytree(lift, tmp_path / "lift")
    path, before = tmp_path / "lift" / "result" / name, contents()
    path.write_bytes(spoil(path.read_bytes()))
    with raises_key(f"file-changed {path.name}"):
        lift_scene.place_lift(tmp_path / "lift", bpy.context.scene)
    assert contents() == before
    if path.suffix != ".exr":  # that one is Blender's to read: its header is looked at, see above
        refuses(tmp_path / "lift", f"array-unreadable|instances-damaged {path.name}")


def test_passes_missing_from_the_manifest_are_not_opened(lift: Path, tmp_path: Path) -> None:
    shutil.copytree(lift, tmp_path / "lift")
    (tmp_path / "lift" / "result" / "passes" / "0000.exr").write_bytes(b"\0")
    assert sorted(read_result(tmp_path / "lift").passes) == sorted(read_result(lift).passes)


def with_instances(lift: Path, folder: Path, text: str) -> None:
    """A copy of the lift with this instances.json is refused."""
    shutil.copytree(lift, folder / "lift")
    (folder / "lift" / "result" / "instances.json").write_text(text)
    refuses(folder / "lift", "instances-damaged|too-many instances.json")


def refuses(lift: Path, place: str) -> None:
    mend_manifest(lift)
    before = contents()
    with raises_key(place):
        lift_scene.place_lift(lift, bpy.context.scene)
    assert contents() == before


@pytest.mark.skipif(os.name == "nt", reason="such names exist elsewhere only")
@pytest.mark.parametrize("name", [b"r\xf6om", b"a\\room"])
def test_a_lift_folder_with_a_name_unusable_in_blender_is_refused(lift: Path, tmp_path: Path, name: bytes) -> None:
    folder = tmp_path / os.fsdecode(name)
    try:
        shutil.copytree(lift.parent / "tiny room", folder)
    except OSError:
        pytest.skip("this disk has no such names")
    before = contents()
    with raises_key("bad-name"):
        place_scene(ChosenScene(folder), bpy.context.scene)
    assert contents() == before


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("name", "\x1b[31m\x07\u202ered\ntwo\0"),
        ("name", "../../etc/passwd"),
        ("name", ""),
        ("name", "ä" * 500),
        ("class_name", "\x9b\u2028"),
        ("size", [1e6, 0.0, -1e6]),
        ("centre", [1e6, -1e6, 1e6]),
        ("rotation", [0.0, 0.0, 0.0, 0.0]),
        ("rotation", [1e6, 1e6, 0.0, 0.0]),
    ],
)
def test_unusual_values_of_instances_give_valid_objects(lift: Path, tmp_path: Path, name: str, value: object) -> None:
    shutil.copytree(lift, tmp_path / "lift")
    path = tmp_path / "lift" / "result" / "instances.json"
    content = json.loads(path.read_text())
    content["instances"][0][name] = value
    path.write_text(json.dumps(content))
    mend_manifest(tmp_path / "lift")
    root = lift_scene.place_lift(tmp_path / "lift", bpy.context.scene)
    box = boxes_of(root)[content["instances"][0]["id"]]
    bpy.context.view_layer.update()
    assert box.name.isprintable() and str(box["class"]).isprintable()
    assert np.isfinite(np.array(box.matrix_world)).all() and np.isfinite(np.array(box.bound_box)).all()
    with registered():
        assert root.plgs.instances[0].name.isprintable()
        views.frame_instance(root, box["instance_id"], all_views()[0].spaces.active)
        assert np.isfinite(np.array(all_views()[0].spaces.active.region_3d.view_location)).all()


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
def test_no_code_in_a_broken_lift_is_run(lift: Path, tmp_path: Path, are_scripts_allowed: bool) -> None:
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
def test_saving_over_a_file_that_is_no_blend_gives_a_one_line_error(
    lift: Path, tmp_path: Path, make: Callable[[Path], None]
) -> None:
    """Blender would wait for ever for whoever writes into the FIFO."""
    blend = tmp_path / "lift.blend"
    make(blend)
    before, there = contents(), sorted(tmp_path.rglob("*"))
    with pytest.raises(PlgsError) as error:
        lift_scene.save_lift(lift, blend)
    assert "\n" not in str(error.value) and "lift.blend" in str(error.value)
    assert contents() == before and sorted(tmp_path.rglob("*")) == there


def test_saving_over_a_link_keeps_the_file_it_leads_to(lift: Path, tmp_path: Path) -> None:
    theirs, blend = tmp_path / "theirs.blend", tmp_path / "lift.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(theirs))
    before = theirs.read_bytes()
    blend.symlink_to(theirs)
    lift_scene.save_lift(lift, blend)
    assert theirs.read_bytes() == before and not blend.is_symlink()


def test_saving_never_overwrites_a_file_of_a_newer_blender(lift: Path, tmp_path: Path) -> None:
    blend = tmp_path / "lift.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend), copy=True, compress=False)
    content = blend.read_bytes()
    newer = re.sub(rb"(v\d+)\d\d", rb"\g<1>99", content[:20]) + content[20:]  # 4.99, or 5.99
    blend.write_bytes(newer)
    with raises_key("newer-blend"):
        lift_scene.save_lift(lift, blend)
    assert blend.read_bytes() == newer


@pytest.mark.parametrize("every", [6, pytest.param(1, marks=pytest.mark.slow)], ids=["some", "all"])
def test_custom_properties_of_unexpected_types_are_ignored(tmp_path: Path, every: int) -> None:
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


ONE = {
    "id": 1, "name": "chair 1", "class_id": 1, "class_name": "chair", "colour": [1, 2, 3], "centre": [0, 0, 0.5],
    "size": [1, 1, 1], "yaw": 0.0, "rotation": [1, 0, 0, 0], "views": 1, "score": 0.5, "points": 7,
}  # fmt: skip
CLASSES = [{"id": 1, "name": "chair", "is_thing": True, "colour": [9, 9, 9]}]
WHOLE = {"format": 1, "up": "z", "classes": CLASSES, "instances": [ONE, ONE | {"id": 2, "name": "\ttürkis\u2028"}]}
MASK = {"frame": "0001", "segment_id": 3, "class_id": 1, "score": 0.5, "outline": ";".join(["0.100,0.200"] * 9)}
LONG = WHOLE | {"instances": [ONE | {"segments": [MASK] * 1500}]}
GOOD = [
    json.dumps(WHOLE), json.dumps(WHOLE, indent=1, ensure_ascii=False), "\ufeff" + json.dumps(WHOLE), json.dumps(LONG),
    json.dumps(WHOLE | {"instances": []}), json.dumps(dict(reversed(WHOLE.items()))),
    json.dumps(WHOLE).replace(",", " \n,\r\t").replace(":", " : "),
    json.dumps(WHOLE | {"classes": [CLASSES[0] | {"id": number} for number in range(1, 65_535)]}),
]  # fmt: skip
PLAIN = json.dumps(WHOLE)
BAD = [
    "", "[]", "7", "{", "}", "{}", PLAIN[:-1], PLAIN[:-2], PLAIN[:200], PLAIN + "}", PLAIN.replace(":", ";"),
    PLAIN.replace('"up": "z",', '"up"'), PLAIN.replace("}, {", "} {"), PLAIN.replace("}]}", "},]}"),
    PLAIN.replace("0.5", "NaN"), PLAIN.replace('"instances": [', '"instances": '),
    PLAIN.replace('"instances": [', '"instances": [7, '), '{"instances": ' + "[" * 5000,
    '{"instances": [' + "[" * 100_000,
]  # fmt: skip


@pytest.mark.parametrize("text", GOOD, ids=range(len(GOOD)))
def test_reading_instances_in_parts_gives_the_same_instances(tmp_path: Path, text: str) -> None:
    path = tmp_path / "instances.json"
    path.write_text(text, encoding="utf-8")
    assert result_of(reading_instances(path)) == read_instances(path)


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_a_broken_instances_json_gives_a_one_line_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "instances.json"
    path.write_text(text, encoding="utf-8")
    for read in (read_instances, lambda path: result_of(reading_instances(path))):
        with pytest.raises(PlgsError) as error:
            read(path)
        assert "\n" not in str(error.value) and len(str(error.value)) < 2000


def test_an_instances_json_of_another_format_version_is_named(tmp_path: Path) -> None:
    path = tmp_path / "instances.json"
    path.write_text(json.dumps(WHOLE | {"format": 2, "instances": [{"id": "chair"}]}))
    for read in (read_instances, lambda path: result_of(reading_instances(path))):
        with raises_key("other-format"):
            read(path)


def test_a_lift_with_200000_objects_is_refused_before_reading(tmp_path: Path) -> None:
    path = tmp_path / "instances.json"
    several = json.dumps(ONE)[:-1] + ', "segments": []}'
    path.write_text(PLAIN[: PLAIN.index("[{", 100) + 1] + ",".join([several] * 200_000))
    with raises_key("too-many 5000"):
        result_of(reading_instances(path))
