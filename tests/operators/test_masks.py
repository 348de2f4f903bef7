"""Making masks from a script, and editing the classes of those that are there."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import bpy
import pytest
from plgs.plgs_blender import engine_environment, registry
from plgs.plgs_blender.running.preparation import MaskMaking
from plgs.plgs_blender.settings import chosen_scene

from engine.scene import open_scene
from tests.tiny_scene import write_tiny_scene

HAS_TRANSFORMERS = all(importlib.util.find_spec(name) for name in ("torch", "transformers"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path / "room", frames=3, size=(64, 48), ground_truth=False)


@pytest.fixture
def bare(folder: Path) -> Path:
    """Without masks."""
    shutil.rmtree(folder / "panoptic")
    (folder / "panoptic.json").unlink()
    return folder


def test_classes_are_read_merged_and_written(folder: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(folder)
    assert bpy.ops.plgs.read_classes() == {"FINISHED"}
    rows = bpy.context.scene.plgs_masks.classes
    assert [(row.name, row.into, row.is_thing) for row in rows][2:4] == [("cabinet", "", True), ("chair", "", True)]
    rows["chair"].into, rows["ceiling"].into, rows["wall"].name = "cabinet", "void", "walls"
    rows["cabinet"].is_thing = False
    assert bpy.ops.plgs.write_classes() == {"FINISHED"}
    classes = open_scene(folder).classes
    assert [(each.name, each.is_thing) for each in classes.categories] == [
        ("walls", False), ("floor", False), ("cabinet", False)
    ]  # fmt: skip
    bpy.ops.plgs.read_classes()
    assert {row.name: row.into for row in bpy.context.scene.plgs_masks.classes} == {
        "walls": "", "floor": "", "cabinet": "", "chair": "cabinet", "ceiling": "void"
    }  # fmt: skip


def test_a_file_that_the_blend_names_is_not_overwritten(folder: Path, tmp_path: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(folder)
    bpy.ops.plgs.read_classes()
    other = tmp_path / "of_the_user.txt"
    other.write_text("mine")
    bpy.context.scene.plgs_masks.path = str(other)
    with pytest.raises(RuntimeError, match=r"[Tt]he list is of another scene.*Read the classes again"):
        bpy.ops.plgs.write_classes()
    assert other.read_text() == "mine"


def test_what_is_not_a_list_of_classes_is_not_replaced(folder: Path, tmp_path: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(folder)
    bpy.ops.plgs.read_classes()
    target = Path(bpy.context.scene.plgs_masks.path)
    target.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RuntimeError, match="[Aa] link or a folder, not a file"):
        bpy.ops.plgs.write_classes()
    assert target.is_symlink()


def test_a_missing_model_is_reported(bare: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(bare)
    with pytest.raises(RuntimeError, match="[Nn]o such folder or model: nowhere"):
        bpy.ops.plgs.make_masks(model="nowhere")
    making, settings = registry.latest(MaskMaking), bpy.context.scene.plgs
    assert making is not None and not making.is_running and making.error is not None
    assert making.error_for(chosen_scene(settings)) == making.error
    settings.scene_folder = str(bare.parent)
    assert making.error_for(chosen_scene(settings)) is None, "another scene has no such error"
    assert not (bare / "panoptic").exists()


@pytest.mark.skipif(not HAS_TRANSFORMERS, reason="needs transformers (requirements/segment.txt)")
def test_masks_are_made_and_shown(
    bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick_python: Path
) -> None:
    from tests.segment.tiny_mask2former import NAMES, save_tiny_mask2former

    monkeypatch.setattr(engine_environment, "usable_python", lambda: quick_python)
    bpy.context.scene.plgs.scene_folder = str(bare)
    model = save_tiny_mask2former(tmp_path / "model")
    assert bpy.ops.plgs.make_masks(model=str(model)) == {"FINISHED"}
    assert [each.name for each in open_scene(bare).classes.categories] == NAMES
    making = registry.latest(MaskMaking)
    assert making is not None and making.answer is not None and making.answer["frames"] == 3
