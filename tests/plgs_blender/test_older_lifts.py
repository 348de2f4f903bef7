"""A lift that version 0.1.0 made of the tiny room, with one correction, goes on in this version.

tests/data/lift_0_1_0.zip holds the scene and its lift, without the checkpoint. It was made at commit 8e994d66.
"""

import shutil
from pathlib import Path

import bpy
import pytest
from plgs.plgs_blender.lift_scene import place_lift

from engine.command_line.main import main
from tests.commands import exit_code

ARCHIVE = Path(__file__).parents[1] / "data" / "lift_0_1_0.zip"


@pytest.fixture
def lift(tmp_path: Path, engines_are_forks: None) -> Path:
    shutil.unpack_archive(ARCHIVE, tmp_path)
    return tmp_path / "lift_0_1_0" / "lift"


def test_an_older_lift_is_baked_with_its_corrections(lift: Path, tmp_path: Path) -> None:
    out = tmp_path / "passes"
    assert exit_code(main, "bake", lift, "--frames", "0001", "-o", out) == 0
    assert b"my chair" in next(out.rglob("0001.exr")).read_bytes()


def test_an_older_lift_can_be_corrected_further(lift: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(main, "correct", lift, "rename", "2", "armchair") == 0
    assert exit_code(main, "correct", lift, "list") == 0
    listed = capsys.readouterr().out
    assert "my chair" in listed and "armchair" in listed and "2 edits" in listed


def test_an_older_lift_is_exported_and_scored(lift: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(main, "export", lift, "--to", "boxes", "-o", tmp_path / "boxes") == 0
    assert any("my chair" in file.read_text(errors="replace") for file in (tmp_path / "boxes").rglob("*.*"))
    assert exit_code(main, "evaluate", lift) == 0
    assert "lifted       strict" in capsys.readouterr().out


def test_blender_shows_an_older_lift(lift: Path) -> None:
    placed = place_lift(lift, bpy.context.scene)
    assert any("my chair" in each.name for each in placed.all_objects)


def test_a_new_lift_keeps_the_names_of_an_older_version(lift: Path, capsys: pytest.CaptureFixture[str]) -> None:
    again = ["lift", lift.parent / "scene", "-o", lift.parent / "new", "--names-from", lift]
    assert exit_code(main, *again, "--steps", "2", "--set", "voxel_size=0.2", "--bake", "none") == 0
    assert exit_code(main, "correct", lift.parent / "new", "list") == 0
    assert "my chair" in capsys.readouterr().out
