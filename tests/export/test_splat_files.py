"""Gaussians in the files of other programs, read back by gsply and, for glTF, by the extension's own text."""

import json
import struct
from pathlib import Path
from types import SimpleNamespace

import gsply
import numpy as np
import pytest
from numpy.typing import NDArray

from engine.export.points import export_splats
from engine.export.splat_files import splats_glb, spz_bytes
from engine.passes.ply import write_ply_table
from engine.posed.ply import read_gaussians

FLOATS = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
WHOLE = {"class_id": "<i4", "instance_id": "<i4", "red": "u1", "green": "u1", "blue": "u1"}
UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From z up to y up."""


@pytest.fixture
def rows() -> NDArray[np.void]:
    random = np.random.default_rng(7)
    made = np.zeros(400, [*((name, "<f4") for name in FLOATS), *WHOLE.items()])
    for name in FLOATS:
        made[name] = random.normal(size=len(made))
    for axis in range(3):
        made[f"scale_{axis}"] -= 4
    for name in WHOLE:
        made[name] = random.integers(0, 256, len(made))
    return made


def table(rows: NDArray[np.void], names: str) -> NDArray[np.float64]:
    return np.stack([rows[name] for name in names.split()], axis=1).astype(np.float64)


def rotations(wxyz: NDArray[np.floating]) -> NDArray[np.float64]:
    """Matrices [N, 3, 3] of quaternions [N, 4]."""
    w, x, y, z = (wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)).astype(np.float64).T
    return np.moveaxis(
        np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]), 2, 0,
    )  # fmt: skip


def test_splats_in_ply_are_floats_that_other_programs_read(rows: NDArray[np.void], tmp_path: Path) -> None:
    """nianticlabs/spz and others refuse a file with any other column. Ours come back as they were."""
    path = tmp_path / "splats.ply"
    write_ply_table(path, {name: rows[name].astype(np.float32) for name in rows.dtype.names or ()})
    header = path.read_bytes().partition(b"end_header")[0]
    assert header.count(b"\nproperty ") == header.count(b"\nproperty float ") == len(FLOATS) + len(WHOLE)
    told = gsply.plyread(str(path))
    np.testing.assert_array_equal(told.means, table(rows, "x y z"))
    np.testing.assert_array_equal(told.quats, table(rows, "rot_0 rot_1 rot_2 rot_3"))
    back = read_gaussians(path)
    assert back.dtype == rows.dtype and (back == rows).all()


@pytest.mark.parametrize("value", [np.nan, 3e9, -3e9])
def test_gaussians_with_impossible_ids_are_not_read(rows: NDArray[np.void], tmp_path: Path, value: float) -> None:
    columns = {name: rows[name].astype(np.float32) for name in rows.dtype.names or ()}
    columns["instance_id"][3] = value
    write_ply_table(tmp_path / "splats.ply", columns)
    assert (read_gaussians(tmp_path / "splats.ply") == np.delete(rows, 3)).all()


@pytest.mark.parametrize(
    ("change", "told"),
    [("x", "1 Gaussian with impossible"), ("far", "1 Gaussian beyond 2048 m"), ("none", "splats.glb is not written")],
)
def test_a_splat_export_warns_of_splats_that_the_file_cannot_hold(
    rows: NDArray[np.void], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str, told: str
) -> None:
    rows["x"][0] = {"x": np.nan, "far": 3000.0}.get(change, 0.0)
    rows = rows[:0] if change == "none" else rows
    path, warned = tmp_path / "gaussians.ply", list[str]()
    write_ply_table(path, {name: rows[name] for name in rows.dtype.names or ()})
    monkeypatch.setattr("engine.export.points.labels_text", lambda *_: "{}")
    folder = SimpleNamespace(result_path=tmp_path)
    lift = SimpleNamespace(splats=read_gaussians(path), folder=folder, warn=warned.append, classes=None, instances=None)
    export_splats(lift, tmp_path / "out")  # type: ignore[arg-type]
    assert len(warned) == 1 and told in warned[0]
    assert (tmp_path / "out" / "splats.glb").exists() == (change != "none")


def test_an_exported_spz_is_read_by_another_library(rows: NDArray[np.void], tmp_path: Path) -> None:
    """Within the steps of the format: 1/4096 m, 1/16 of a logarithm, 1/255 of opacity, half of 1/(255 * 0.15)."""
    (tmp_path / "splats.spz").write_bytes(spz_bytes(rows))
    told = gsply.read_spz(str(tmp_path / "splats.spz"))
    np.testing.assert_allclose(told.means, table(rows, "x y z") @ UP.T, atol=1.3e-4)
    np.testing.assert_allclose(told.scales, table(rows, "scale_0 scale_1 scale_2"), atol=0.0313)
    np.testing.assert_allclose(told.sh0, table(rows, "f_dc_0 f_dc_1 f_dc_2"), atol=0.0131)
    alpha, own = (1 / (1 + np.exp(-values)) for values in (told.opacities.ravel(), rows["opacity"]))
    np.testing.assert_allclose(alpha, own, atol=0.002)
    turned = UP @ rotations(table(rows, "rot_0 rot_1 rot_2 rot_3"))
    np.testing.assert_allclose(rotations(told.quats), turned, atol=0.006)


def test_gltf_splats_follow_khr_gaussian_splatting(rows: NDArray[np.void]) -> None:
    """Read by the rules of KHR_gaussian_splatting: linear scales and opacities, quaternions xyzw, y up."""
    content = splats_glb(rows)
    magic, version, size, length, kind = struct.unpack_from("<4sII I4s", content)
    assert (magic, version, size, kind) == (b"glTF", 2, len(content), b"JSON")
    told, body = json.loads(content[20 : 20 + length]), content[28 + length :]
    (primitive,) = told["meshes"][0]["primitives"]
    assert told["extensionsUsed"] == ["KHR_gaussian_splatting"] and primitive["mode"] == 0
    shown = primitive["extensions"]["KHR_gaussian_splatting"]
    assert shown == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}

    def values(name: str) -> NDArray[np.float32]:
        accessor = told["accessors"][primitive["attributes"][name]]
        view = told["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert accessor["componentType"] == 5126 and view["byteLength"] == 4 * width * accessor["count"]
        return np.frombuffer(body, "<f4", width * accessor["count"], view["byteOffset"]).reshape(-1, width)

    own = "KHR_gaussian_splatting:"
    np.testing.assert_allclose(values("POSITION"), table(rows, "x y z") @ UP.T, atol=1e-6)
    np.testing.assert_allclose(values(own + "SCALE"), np.exp(table(rows, "scale_0 scale_1 scale_2")), rtol=1e-5)
    np.testing.assert_allclose(values(own + "OPACITY")[:, 0], 1 / (1 + np.exp(-rows["opacity"])), atol=1e-6)
    np.testing.assert_array_equal(values(own + "SH_DEGREE_0_COEF_0"), table(rows, "f_dc_0 f_dc_1 f_dc_2"))
    turns = values(own + "ROTATION")[:, (3, 0, 1, 2)]
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1, atol=1e-5)
    turned = UP @ rotations(table(rows, "rot_0 rot_1 rot_2 rot_3"))
    np.testing.assert_allclose(rotations(turns), turned, atol=1e-5)
    np.testing.assert_array_equal(values("_INSTANCE_ID")[:, 0], rows["instance_id"])
