"""A .blend from somebody else, and passes that are no passes: what is placed is whole, what is refused says so."""

from __future__ import annotations

import io
import shutil
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plgs.engine.errors import PlgsError
from plgs.engine.job.cameras import LARGEST_SIDE
from plgs.plgs_blender import lift_scene, passes
from plgs.plgs_blender.results import read_result
from tiny_lift import mend_manifest, write_tiny_lift

from tests.fuzzing import damaged, examples

EXPECTED = (PlgsError, OSError)
ODD: list[Any] = [7, 1.5, True, [1, 2], {"a": 1}, "", "instance:x", "//", "/dev/zero", "\\\\host\\share", None]
"""None: the property is gone."""
KINDS = ("scenes", "collections", "objects", "cameras", "pointclouds", "meshes", "images", "node_groups")
OURS = ("plgs_", "frame", "class_id")


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_lift(tmp_path_factory.mktemp("lifts") / "lift", frames=5, size=(16, 12)).path


@pytest.fixture(scope="module")
def placed(small: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A .blend that has the lift."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    lift_scene.place_lift(small, bpy.context.scene)
    path = tmp_path_factory.mktemp("blend") / "file.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


@pytest.mark.parametrize("every", [6, pytest.param(1, marks=pytest.mark.slow)], ids=["some", "all"])
def test_odd_custom_properties(small: Path, placed: Path, every: int) -> None:
    """Each of ours, on one block of each kind, with other values: none of Python's own errors comes of it."""
    bpy.ops.wm.open_mainfile(filepath=str(placed))
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


@examples(25)
@given(data=st.data())
def test_damaged_headers_of_passes(small: Path, tmp_path: Path, data: st.DataObject) -> None:
    whole = next((small / "result" / "passes").iterdir()).read_bytes()[:4000]
    (tmp_path / "a.exr").write_bytes(damaged(data.draw, whole))
    assert all(0 <= side <= LARGEST_SIDE for side in passes.size_of(tmp_path / "a.exr"))
    with suppress(PlgsError):
        passes.check_layers([tmp_path / "a.exr"])


@examples(30)
@given(data=st.data(), name=st.sampled_from(["semantic_points.npz", "anchors.npz"]))
def test_damaged_arrays(small: Path, tmp_path: Path, data: st.DataObject, name: str) -> None:
    """With checksums that fit: somebody made them so."""
    lift = tmp_path / "lift"
    shutil.rmtree(lift, ignore_errors=True)
    shutil.copytree(small, lift)
    path = lift / "result" / name
    if data.draw(st.booleans()):
        path.write_bytes(damaged(data.draw, path.read_bytes()))
    else:
        with zipfile.ZipFile(path) as archive:
            arrays = {entry: archive.read(entry) for entry in archive.namelist()}
        entry = data.draw(st.sampled_from(sorted(arrays)))
        arrays[entry] = damaged(data.draw, arrays[entry][:200]) + arrays[entry][200:]
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w") as archive:
            for each, body in arrays.items():
                archive.writestr(each, body)
        path.write_bytes(content.getvalue())
    mend_manifest(lift)
    try:
        result = read_result(lift)
    except PlgsError as error:
        assert "\n" not in str(error) and error.fix
    else:
        assert np.isfinite(result.points.xyz).all()
