"""Tables of scenes for `batch`: each row has the options of a lift, and errors name the row."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import pytest

from engine.command_line.batch import read_scene_table
from engine.command_line.main import make_parser
from engine.errors import PlgsError


def options_of(folder: Path, name: str, text: str, *command: str) -> list[argparse.Namespace]:
    (folder / name).write_text(text, encoding="utf-8")
    options = make_parser().parse_args(["batch", "--scenes", str(folder / name), "-o", "out", *command])
    return read_scene_table(folder / name, options)


CSV = """\
scene,name,up,masks,mask_format,set,fit,classes
scans/office,,,,,,,
/data/kitchen,"kitchen, old",-y,masks/k,coco,voxel_size=0.1,yes,coco.toml
"""
TOML = """
[[scene]]
scene = "scans/office"
[[scene]]
scene = "/data/kitchen"
name = "kitchen, old"
up = "-y"
masks = "masks/k"
mask-format = "coco"
set = ["voxel_size=0.1"]
fit = true
classes = "coco.toml"
"""


@pytest.mark.parametrize(("name", "text"), [("scans.csv", "\ufeff" + CSV), ("scans.toml", TOML)])
def test_each_scene_has_its_own_options(name: str, text: str, tmp_path: Path) -> None:
    office, kitchen = options_of(tmp_path, name, text, "--up", "y", "--seed", "3", "--set", "majority=0.6")
    assert (office.scene, office.scene_name, office.up) == (tmp_path / "scans/office", "", "y")
    assert (kitchen.scene, kitchen.scene_name, kitchen.up) == (Path("/data/kitchen"), "kitchen, old", "-y")
    assert (office.seed, kitchen.seed, office.masks, kitchen.masks) == (3, 3, None, tmp_path / "masks/k")
    assert (office.set, kitchen.set) == (["majority=0.6"], ["majority=0.6", "voxel_size=0.1"])
    assert (office.fit, kitchen.fit, kitchen.classes) == (None, True, str(tmp_path / "coco.toml"))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("t.csv", "scene,up\na,y\nb,sideways\n", "t.csv, scene 2"),
        ("t.csv", "scene,colour\na,red\n", "unrecognized arguments: --colour=red"),
        ("t.csv", "name,up\na,y\n", "a scene has no 'scene'"),
        ("t.csv", "scene,bake\na,all\n", "bake cannot differ between scenes"),
        ("t.csv", "", "names no scene"),
        ("t.csv", "scene\na,b,c\n", "t.csv"),
        ("t.toml", "scene = 'a'", "is not a table of scenes"),
        ("t.toml", "[[scene]]\nscene = {}", "t.toml, scene 1"),
        ("t.toml", "[[scene]\n", "is not a table of scenes"),
    ],
)
def test_a_bad_table_is_one_line(name: str, text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(PlgsError) as error:
        options_of(tmp_path, name, text)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_a_missing_table(tmp_path: Path) -> None:
    options: Any = argparse.Namespace()
    with pytest.raises(PlgsError, match="cannot be read"):
        read_scene_table(tmp_path / "none.csv", options)
