"""COLMAP's models, text and binary, written from its documentation."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.scene import open_scene
from tests.raises_key import raises_key
from tests.scene.formats import room
from tests.scene.refusing import describe, refuses

LENS = room.Lens().scaled(2)
PINHOLE = ("PINHOLE", (LENS.fx, LENS.fy, LENS.cx, LENS.cy))


def marks() -> np.ndarray:
    """World points that cameras see, float64 [6, 3]: one on each camera's axis, a metre away."""
    return np.array([room.elsewhere(view).eye + room.elsewhere(view).forward for view in room.views()])


def world_to_camera(view: room.View) -> tuple[np.ndarray, np.ndarray]:
    """COLMAP's q (w x y z) and t: a world point X lies at R(q) X + t, x right, y down, z forward."""
    rows = np.stack([view.right, -view.up, view.forward])
    return room.quaternion(rows), -rows @ view.eye


def image_name(index: int) -> str:
    return f"img_{index + 5}.png"


def write_text(folder: Path, model: tuple[str, tuple[float, ...]] = PINHOLE) -> Path:
    """The pictures, and the model in sparse/0 as text; images in another order than their names."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    for i, view in enumerate(room.views()):
        room.write_colour(folder / "images" / image_name(i), room.look(view, LENS).colour)
    name, parameters = model
    (sparse / "cameras.txt").write_text(
        f"# Camera list with one line of data per camera:\n3 {name} 128 96 {' '.join(map(repr, parameters))}\n"
    )
    lines = ["# Image list with two lines of data per image:"]
    for i, view in reversed([*enumerate(room.views())]):
        q, t = world_to_camera(room.elsewhere(view))
        lines.append(f"{i + 1} {' '.join(f'{v:.9f}' for v in (*q, *t))} 3 {image_name(i)}")
        lines.append(f"{LENS.cx} {LENS.cy} {100 + i} 5.0 6.0 -1" if i != 2 else "")
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    points = [f"{100 + i} {x} {y} {z} 9 8 7 0.5{f' {i + 1} 0' * (i != 2)}\n" for i, (x, y, z) in enumerate(marks())]
    (sparse / "points3D.txt").write_text("# 3D point list\n" + "".join(reversed(points)))
    return folder


def write_depth(folder: Path) -> None:
    """As COLMAP's stereo does: width & height & channels & float32, x fastest."""
    (folder / "stereo" / "depth_maps").mkdir(parents=True, exist_ok=True)
    for i, view in enumerate(room.views()):
        depth = room.look(view, LENS).depth
        data = b"128&96&1&" + b"".join(struct.pack("<128f", *row) for row in depth)
        (folder / "stereo" / "depth_maps" / f"{image_name(i)}.geometric.bin").write_bytes(data)


def test_a_colmap_text_model_is_read_with_pictures_and_points(tmp_path: Path) -> None:
    scene = open_scene(write_text(tmp_path))
    assert scene.format == "colmap" and not scene.has_depth and describe(scene).sparse_points == 6
    assert [frame.name for frame in scene.frames] == [f"img_{i + 5}" for i in range(6)]
    room.check_colours(scene)
    assert scene.points is not None and scene.points.rgb[0].tolist() == [9, 8, 7]
    for i, frame in enumerate(scene.frames):
        seen = scene.points.seen_by[frame.name]
        assert len(seen) == (i != 2)
        if len(seen):
            pixel, depth = frame.camera.project(scene.points.xyz[seen])
            np.testing.assert_allclose([*pixel[0], depth[0]], [LENS.cx, LENS.cy, 1.0], atol=1e-5)


@pytest.mark.parametrize("place", ["dense/0", "dense"])
def test_depth_maps_of_a_colmap_workspace_are_found(tmp_path: Path, place: str) -> None:
    """Its pictures are undistorted and of another size than the photos; empty folders are no depth."""
    write_text(tmp_path, ("RADIAL", (LENS.fx, LENS.cx, LENS.cy, -0.1, 0.03)))
    (tmp_path / "stereo" / "depth_maps").mkdir(parents=True)
    (tmp_path / place / "stereo" / "depth_maps").mkdir(parents=True)
    assert not open_scene(tmp_path).has_depth
    write_depth(write_text(tmp_path / place))
    for file in (tmp_path / place / "sparse" / "0").iterdir():
        file.rename(tmp_path / place / "sparse" / file.name)
    scene = open_scene(tmp_path)
    assert any(f"depth is in {place}" in warning for warning in scene.warnings)
    assert scene.frames[0].camera.fy == LENS.fy and scene.frames[0].file_shows_colour
    room.check_on_room(scene)


def test_broken_colmap_depth_maps_are_reported(tmp_path: Path) -> None:
    """Some numbers that are no depth are none; a file of them is broken."""
    write_depth(write_text(tmp_path))
    path = tmp_path / "stereo" / "depth_maps" / f"{image_name(0)}.geometric.bin"
    whole = path.read_bytes()
    bad = struct.pack("<4f", 1.7e38, -2e9, float("nan"), float("inf"))
    path.write_bytes(whole[: -len(bad)] + bad)
    depth = open_scene(tmp_path).frames[0].depth()
    assert (depth[-1, -4:] == 0.0).all() and (depth[:-1] > 0.0).all()
    path.write_bytes(b"128&96&1&" + bad * (128 * 96 // 4))
    with raises_key("depth-broken 100% img_ geometric.bin"):
        open_scene(tmp_path).frames[0].depth()


@pytest.mark.parametrize("place", ["sparse", "model", "."])
def test_a_colmap_model_is_found_in_its_usual_folders(tmp_path: Path, place: str) -> None:
    write_text(tmp_path)
    (tmp_path / place).mkdir(exist_ok=True)
    for file in (tmp_path / "sparse" / "0").iterdir():
        file.rename(tmp_path / place / file.name)
    room.check_colours(open_scene(tmp_path))


def radial(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scale = 1 - 0.1 * (x**2 + y**2) + 0.03 * (x**2 + y**2) ** 2
    return x * scale, y * scale


def simple_fisheye(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r = np.maximum(np.hypot(x, y), 1e-12)
    angle = np.arctan(r)
    scale = angle * (1 + 0.04 * angle**2) / r
    return x * scale, y * scale


@pytest.mark.parametrize(
    ("model", "bend"),
    [
        (("RADIAL", (LENS.fx, LENS.cx, LENS.cy, -0.1, 0.03)), radial),
        (("SIMPLE_RADIAL_FISHEYE", (LENS.fx, LENS.cx, LENS.cy, 0.04)), simple_fisheye),
    ],
)
def test_colmap_pictures_of_distorted_lenses_are_undistorted(
    tmp_path: Path, model: tuple[str, tuple[float, ...]], bend: room.Bend
) -> None:
    write_text(tmp_path, model)
    for i, view in enumerate(room.views()):
        room.write_colour(
            tmp_path / "images" / image_name(i), room.look_bent(view, replace(LENS, fy=LENS.fx), bend).colour
        )
    room.check_colours(open_scene(tmp_path), share=0.93)  # edges between colours are blended


def binary(folder: Path) -> Path:
    """The same model as COLMAP's documentation lays its binary files out."""
    write_text(folder)
    sparse = folder / "sparse" / "0"
    for file in sparse.glob("*.txt"):
        file.unlink()
    (sparse / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 3, 1, 128, 96, *PINHOLE[1]))
    images = struct.pack("<Q", 6)
    for i, view in enumerate(room.views()):
        q, t = world_to_camera(room.elsewhere(view))
        images += struct.pack("<I7dI", i + 1, *q, *t, 3) + image_name(i).encode() + b"\0"
        images += struct.pack("<QddqddQ", 2, LENS.cx, LENS.cy, 100 + i, 5.0, 6.0, 2**64 - 1)
    (sparse / "images.bin").write_bytes(images)
    points = struct.pack("<Q", 6)
    for i, mark in enumerate(marks()):
        points += struct.pack("<Q3d3BdQII", 100 + i, *mark, 9, 8, 7, 0.5, 1, i + 1, 0)
    (sparse / "points3D.bin").write_bytes(points)
    return folder


def test_binary_colmap_models_are_read(tmp_path: Path) -> None:
    scene = open_scene(binary(tmp_path))
    room.check_colours(scene)
    assert scene.points is not None
    for frame in scene.frames:
        pixel, depth = frame.camera.project(scene.points.xyz[scene.points.seen_by[frame.name]])
        np.testing.assert_allclose([*pixel[0], depth[0]], [LENS.cx, LENS.cy, 1.0], atol=1e-5)


@pytest.mark.parametrize(
    ("number", "model", "count"),
    [
        (7, "FOV", 5), (11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
        (12, "SIMPLE_DIVISION", 4), (13, "DIVISION", 5), (14, "SIMPLE_FISHEYE", 3), (15, "FISHEYE", 4), (16, "EUCM", 6),
        (17, "EQUIRECTANGULAR", 2), (18, "NEWEST", 4),
    ],
)  # fmt: skip
def test_unsupported_colmap_lenses_are_refused_with_advice(tmp_path: Path, number: int, model: str, count: int) -> None:
    values = [64.0] * count
    write_text(tmp_path / "text", (model, tuple(values)))
    cameras = binary(tmp_path / "binary") / "sparse" / "0" / "cameras.bin"
    cameras.write_bytes(struct.pack(f"<QIiQQ{count}d", 1, 3, number, 128, 96, *values))
    for folder in ("text", "binary"):
        told = "18" if (number, folder) == (18, "binary") else model
        error = refuses(f"lens-model {told} image_undistorter", tmp_path / folder)
        assert ("panorama" in error.fix) is (model == "EQUIRECTANGULAR")


def test_the_test_pictures_of_gaussian_splatting_are_held_out(tmp_path: Path) -> None:
    write_text(tmp_path)
    (tmp_path / "sparse" / "0" / "test.txt").write_text(f"{image_name(1)}\n{image_name(4)}\nnot_registered.png\n")
    assert [frame.name for frame in open_scene(tmp_path).test_frames] == ["img_6", "img_9"]


def test_pictures_that_colmap_did_not_register_are_reported(tmp_path: Path) -> None:
    folder = write_text(tmp_path)
    first = folder / "images" / image_name(0)
    first.with_stem("extra").write_bytes(first.read_bytes())
    scene = open_scene(folder)
    lost = [each for each in scene.left_out if "register" in each.lacks]
    assert [len(each.names) for each in lost] == [1] and "extra" in lost[0].names[0]
    assert any("extra" in warning for warning in scene.warnings)
