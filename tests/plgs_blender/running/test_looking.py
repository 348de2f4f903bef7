"""What a file that is opened makes Blender read before anybody asks: the list of its lift's objects, in parts."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import bpy
import pytest
from plgs.engine.job.recent import remember_lift
from plgs.plgs_blender import corrections, lift_scene, results
from plgs.plgs_blender.inspecting.selection import find_lift
from plgs.plgs_blender.running import looking

Read = list[Path]


@pytest.fixture(autouse=True)
def extension(plgs: ModuleType, empty_file: None) -> Iterator[None]:
    plgs.register()
    yield
    plgs.unregister()


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> Read:
    """The instances.json of which a first part was read since a file was ``opened``."""
    paths, reading = [], results.reading_instances
    monkeypatch.setattr(results, "reading_instances", lambda path: (paths.append(path), reading(path))[1])
    monkeypatch.setattr(looking, "_PARTS_S", 0.0)  # an object in each part
    return paths


def opened(lift: Path, folder: Path, blend: str, read: Read, *, linked: bool = False) -> Path:
    """A copy of a lift, after a file that shows it was opened as in a Blender that had read nothing. The list of its
    objects is elsewhere if it is ``linked``."""
    shutil.copytree(lift, folder)
    lift_scene.place_lift(folder, bpy.context.scene)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / blend))
    results._kept.clear()
    results._begun.clear()
    read.clear()
    if linked:
        listed = folder / "result" / "instances.json"
        listed.symlink_to(listed.rename(folder.with_suffix(".json")))
    bpy.ops.wm.open_mainfile(filepath=str(folder / blend))
    return folder


def test_an_edit_of_an_opened_file_waits_for_no_reading(lift: Path, tmp_path: Path, read: Read) -> None:
    mine = opened(lift, tmp_path / "mine", "lift.blend", read)
    assert not read, "not while the file is opened"
    parts = 0
    while looking._read_objects() is not None:
        parts += 1
    assert parts == 2 and looking._read_objects() is None
    corrections.delete(find_lift(bpy.context.scene), 2, around=False)
    assert read == [mine / "result" / "instances.json"]


def test_a_path_that_a_file_names_is_read_only_if_it_is_ones_own(lift: Path, tmp_path: Path, read: Read) -> None:
    mine = opened(lift, tmp_path / "mine", "../elsewhere.blend", read)
    assert looking._read_objects() is None and not read
    remember_lift(mine)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "elsewhere.blend"))
    assert looking._read_objects() is not None and len(read) == 1


def test_a_link_in_its_place_is_left_alone(lift: Path, tmp_path: Path, read: Read) -> None:
    opened(lift, tmp_path / "mine", "lift.blend", read, linked=True)
    assert looking._read_objects() is None and not read
