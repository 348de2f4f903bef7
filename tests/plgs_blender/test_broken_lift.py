"""A lift or a scene with something in it that cannot be changes nothing in the open file."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest
from file_contents import contents
from plgs.engine.errors import PlgsError
from plgs.plgs_blender import lift_scene
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.import_scene import place_scene
from plgs.plgs_blender.inspecting import views
from plgs.plgs_blender.inspecting.lists import registered
from plgs.plgs_blender.inspecting.selection import boxes_of
from plgs.plgs_blender.results import MOST_INSTANCES, read_result
from plgs.plgs_blender.viewport import all_views
from tiny_lift import mend_manifest, write_tiny_lift


@pytest.mark.parametrize("content", [b"\0", b"v/1\x01\2\0\0\0channels\0chlist"])
def test_broken_passes_change_nothing(tmp_path: Path, content: bytes) -> None:
    lift = write_tiny_lift(tmp_path / "lift", frames=10).path
    path = next((lift / "result" / "passes").iterdir())
    path.write_bytes(content.ljust(path.stat().st_size, b"\0"))
    before = contents()
    with pytest.raises(PlgsError, match=path.name):
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
def test_absurd_instances_change_nothing(lift: Path, tmp_path: Path, name: str, value: object) -> None:
    content = json.loads((lift / "result" / "instances.json").read_text())
    content["instances"][0][name] = value
    with_instances(lift, tmp_path, json.dumps(content))


def test_more_objects_than_a_lift_finds_change_nothing(lift: Path, tmp_path: Path) -> None:
    content = json.loads((lift / "result" / "instances.json").read_text())
    one = content["instances"][0] | {"segments": []}
    content["instances"] = [one | {"id": number} for number in range(1, MOST_INSTANCES + 2)]
    with_instances(lift, tmp_path, json.dumps(content))


def test_endless_brackets_change_nothing(lift: Path, tmp_path: Path) -> None:
    with_instances(lift, tmp_path, "[" * 100_000)


@pytest.mark.parametrize(
    ("xyz", "message"),
    [
        (lambda xyz: np.full_like(xyz, 3e38), "semantic_points.npz"),
        (lambda xyz: np.zeros((30_000_000, 3), np.float32), "would unpack to"),
    ],
    ids=["absurd", "gigabytes"],
)
def test_bad_positions_change_nothing(lift: Path, tmp_path: Path, xyz: Callable, message: str) -> None:
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
def test_corruption_is_a_one_line_error_and_changes_nothing(
    lift: Path, tmp_path: Path, name: str, spoil: Callable[[bytes], bytes]
) -> None:
    """As a disk leaves it, found by its checksum; or with a manifest that lists the rotten bytes."""
    shutil.copytree(lift, tmp_path / "lift")
    path, before = tmp_path / "lift" / "result" / name, contents()
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(PlgsError, match=f"was changed since it was written: .*{path.name}"):
        lift_scene.place_lift(tmp_path / "lift", bpy.context.scene)
    assert contents() == before
    if path.suffix != ".exr":  # that one is Blender's to read: its header is looked at, see above
        refuses(tmp_path / "lift", path.name)


def test_passes_that_the_manifest_does_not_list_are_not_opened(lift: Path, tmp_path: Path) -> None:
    shutil.copytree(lift, tmp_path / "lift")
    (tmp_path / "lift" / "result" / "passes" / "0000.exr").write_bytes(b"\0")
    assert sorted(read_result(tmp_path / "lift").passes) == sorted(read_result(lift).passes)


def with_instances(lift: Path, folder: Path, text: str) -> None:
    """A copy of the lift with this instances.json is refused."""
    shutil.copytree(lift, folder / "lift")
    (folder / "lift" / "result" / "instances.json").write_text(text)
    refuses(folder / "lift", "instances.json")


def refuses(lift: Path, place: str) -> None:
    mend_manifest(lift)
    before = contents()
    with pytest.raises(PlgsError, match=place):
        lift_scene.place_lift(lift, bpy.context.scene)
    assert contents() == before


@pytest.mark.skipif(os.name == "nt", reason="such names exist elsewhere only")
@pytest.mark.parametrize("name", [b"r\xf6om", b"a\\room"])
def test_folders_that_blender_cannot_name_change_nothing(lift: Path, tmp_path: Path, name: bytes) -> None:
    folder = tmp_path / os.fsdecode(name)
    try:
        shutil.copytree(lift.parent / "tiny room", folder)
    except OSError:
        pytest.skip("this disk has no such names")
    before = contents()
    with pytest.raises(PlgsError, match="Rename it"):
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
def test_odd_instances_are_clean_objects(lift: Path, tmp_path: Path, name: str, value: object) -> None:
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
