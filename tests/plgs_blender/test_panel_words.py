"""Options of a command in the panel's words."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import bpy
import pytest
from plgs.plgs_blender.panel_words import FIELDS, in_panel_words


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (
            "Lift with --frames 40 (--fit finds such a number), or with --size 320x240, or with --preset preview.",
            "Lift with Frames 40 (Fit memory finds such a number), or with Width and Height 320x240, "
            "or with Preset preview.",
        ),
        ("Say which one it is, such as --mask-format coco.", "Say which one it is, such as Mask format coco."),
        ("lift with --up -y", "lift with Up -y"),
        ("read it with --up z, or --fix OUT turns it upright", "read it with Up z, or Fix turns it upright"),
        ("Give masks with --masks, or make them: python -m engine segment SCENE.",
         "Give masks with Masks, or press Make Masks."),
        ("no option 'a': --set. 'python -m engine presets preview' lists them all.",
         "no option 'a': All options. All options lists them all."),
        ("/rooms/a--size 3/x--up", "/rooms/a--size 3/x--up"),
        ("--fits and --unheard-of", "--fits and --unheard-of"),
    ],
)  # fmt: skip
def test_options_are_told_as_fields(said: str, told: str) -> None:
    assert in_panel_words(said) == told


def test_fields_are_called_as_they_are_in_the_panel(plgs: ModuleType) -> None:
    plgs.register()
    try:
        drawn = {each.name for each in bpy.context.scene.plgs.bl_rna.properties}
    finally:
        plgs.unregister()
    named = {name for field in FIELDS.values() for name in field.split(" and ")}
    assert named - drawn == {"All options"}, "a panel of its own"


def test_every_option_that_an_engine_of_the_panel_advises_has_a_word(root: Path) -> None:
    parts = ("scene", "diagnosis", "lift", "segment")
    files = [path for part in parts for path in (root / "engine" / part).rglob("*.py") if "bench" not in path.name]
    advised = {option for path in files for text in _texts(path) for option in re.findall(r"(?<!\w)--[a-z-]+", text)}
    assert len(advised) > 10
    assert {option for option in advised if option in in_panel_words(f"{option} OUT")} == {"--download"}
    assert "--" not in in_panel_words("Add --download to fetch it")


def _texts(path: Path) -> Iterator[str]:
    """All but docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    said = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in said:
            yield node.value
