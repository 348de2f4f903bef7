"""What is the matte in new nodes, and the switch that lets it follow the selection."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest
import tiny_lift
from plgs.engine.scene import open_scene
from plgs.plgs_blender import compat, compositing, lift_scene
from plgs.plgs_blender.inspecting.selection import select_instance
from plgs.plgs_blender.owned import OwnedDataBlocks
from plgs.plgs_blender.pass_nodes import CRYPTO_CLASSES, CRYPTO_INSTANCES, PANOPTIC, node_of
from plgs.plgs_blender.passes import place_shots
from plgs.plgs_blender.results import read_result

from tests.raises_key import raises_key

CHAIR, CABINET = 1, 2


@pytest.fixture
def root(lift: Path, tmp_path: Path, extension: None) -> Iterator[bpy.types.Collection]:
    mine = Path(shutil.copytree(lift, tmp_path / "mine"))  # a new name is a correction
    yield lift_scene.place_lift(mine, bpy.context.scene)


def bake(root: bpy.types.Collection, lift: Path, name: str, tmp_path: Path) -> bpy.types.NodeTree:
    """The nodes of a camera's new passes, as they are placed after a bake."""
    result = read_result(lift)
    frame = open_scene(result.scene.folder).test_frames[0]
    tiny_lift.write_passes(tmp_path / f"{name}.0001.exr", frame, frame.size)
    result.shots[f"{name}.0001"] = tmp_path / f"{name}.0001.exr"
    place_shots(OwnedDataBlocks(root["plgs_lift"], bpy.context.scene), result, bpy.context.scene)
    return compat.compositor_tree(next(scene for scene in bpy.data.scenes if scene.name.endswith(name)))


def matte(tree: bpy.types.NodeTree) -> tuple[str, str]:
    return node_of(tree, CRYPTO_INSTANCES).matte_id, node_of(tree, CRYPTO_CLASSES).matte_id


def test_no_matte_is_shown_without_a_chosen_object(root: bpy.types.Collection, lift: Path, tmp_path: Path) -> None:
    (_, frames), *_ = compositing.compositors_of(root)
    assert matte(frames) == ("", "") == matte(bake(root, lift, "crane", tmp_path))


def test_the_matte_of_a_new_shot_is_the_selected_object(root: bpy.types.Collection, lift: Path, tmp_path: Path) -> None:
    select_instance(root, CABINET, bpy.context.view_layer)
    assert matte(bake(root, lift, "crane", tmp_path)) == ("cabinet 1", "cabinet")


def test_a_new_shot_copies_settings_of_the_last_shot(root: bpy.types.Collection, lift: Path, tmp_path: Path) -> None:
    compositing.matte_instance(root, CABINET)
    (_, frames), *_ = compositing.compositors_of(root)
    controls = node_of(frames, PANOPTIC).inputs
    controls["Isolate"].default_value, controls["Outline colour"].default_value = 0.75, (0.1, 0.2, 0.3, 1.0)
    select_instance(root, CHAIR, bpy.context.view_layer)
    tree = bake(root, lift, "crane", tmp_path)
    assert matte(tree) == matte(frames) and matte(tree)[0] == "cabinet 1"
    mine = node_of(tree, PANOPTIC).inputs
    assert mine["Isolate"].default_value == 0.75
    assert np.allclose(mine["Outline colour"].default_value, (0.1, 0.2, 0.3, 1.0))


def test_the_matte_follows_the_selection_if_asked(root: bpy.types.Collection) -> None:
    (_, tree), *_ = compositing.compositors_of(root)
    select_instance(root, CHAIR, bpy.context.view_layer)
    assert matte(tree) == ("", "")
    root.plgs.matte_follows = True
    assert matte(tree)[0] == "chair 1"
    select_instance(root, CABINET, bpy.context.view_layer)
    assert matte(tree)[0] == "cabinet 1"
    root.plgs.instance_index = -1
    assert matte(tree)[0] == "cabinet 1", "nothing is no choice"


def test_a_matte_needs_passes_with_the_objects_name(root: bpy.types.Collection, lift: Path, tmp_path: Path) -> None:
    (_, tree), *_ = compositing.compositors_of(root)
    compositing.matte_instance(root, CABINET)
    row = next(each for each in root.plgs.instances if each.instance_id == CHAIR)
    row.name = "Anna's chair"
    with raises_key("no-matte"):
        compositing.matte_instance(root, CHAIR)
    assert matte(tree)[0] == "cabinet 1", "what is shown stays"
    row.name = "chair 1"
    compositing.matte_instance(root, CHAIR)
    assert matte(tree)[0] == "chair 1"
