"""Cameras of Metashape, RealityScan and Bundler: projected to 0.01 pixels as their own formulas say."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.job.progress import unwatched
from engine.scene import open_scene
from engine.scene.formats import bundler, metashape, reality
from engine.scene.formats.capture import Capture
from tests.raises_key import raises_key
from tests.scene.formats import room
from tests.scene.refusing import refuses

LENS = room.Lens().scaled(2)
SIZE = (LENS.width, LENS.height)
NONE = dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2", "t1", "t2"), 0.0)
BENT = {"k1": -0.21, "k2": 0.08, "k3": -0.02, "k4": 0.004, "p1": 0.003, "p2": -0.002, "b1": -1.7, "b2": 0.9}
POINTS = np.random.default_rng(3).uniform((-0.9, -1.9, 0.1), (2.9, 1.4, 2.3), (400, 3))
Project = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def photos(folder: Path) -> list[room.View]:
    views = [room.elsewhere(view) for view in room.views()]
    for i, view in enumerate(room.views()):
        room.write_colour(folder / "images" / f"IMG_{i}.png", room.look(view, replace(LENS, fy=LENS.fx)).colour)
    return views


def axes(view: room.View) -> np.ndarray:
    """Camera to world, columns x right, y down, z forward."""
    return np.stack([view.right, -view.up, view.forward], axis=-1)


def metashape_xml(
    folder: Path, numbers: dict[str, float], kind: str = "frame", reference: str = "", scale: float = 0.5,
    whole: bool = False,
) -> Path:  # fmt: skip
    """Poses are in a chunk that is turned, moved and scaled against the world."""
    views, turn = photos(folder), cv2.Rodrigues(np.array([0.3, -0.2, 0.9]))[0]
    shift = np.array([1.0, -2.0, 0.5])
    if reference:  # the room stands on the Earth, at 48 degrees north
        up, east = np.array([np.cos(0.84), 0.0, np.sin(0.84)]), np.array([0.0, 1.0, 0.0])
        ground = np.stack([east, np.cross(up, east), up], axis=-1)
        shift = 6378e3 * up
        views = [replace(v, eye=ground @ v.eye + 6378e3 * up, right=ground @ v.right, up=ground @ v.up,
                         forward=ground @ v.forward) for v in views]  # fmt: skip
    cameras = ""
    for i, view in enumerate(views):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T @ axes(view), turn.T @ (view.eye - shift) / scale
        text = " ".join(f"{value:.17g}" for value in pose.ravel())
        shown = f"<transform>{text}</transform>" if i != 2 or whole else ""
        enabled = ' enabled="false"' if i == 4 and not whole else ""
        cameras += f'<camera id="{i}" sensor_id="7" component_id="0" label="IMG_{i}"{enabled}>{shown}</camera>'
    calibration = {"f": LENS.fx, "cx": LENS.cx - SIZE[0] / 2, "cy": LENS.cy - SIZE[1] / 2, **numbers}
    shown = "".join(f"<{name}>{value!r}</{name}>" for name, value in calibration.items() if value and name[0] != "t")
    size = f'<resolution width="{SIZE[0]}" height="{SIZE[1]}"/>'
    moved = (
        f"<transform><rotation>{' '.join(map(repr, map(float, turn.ravel())))}</rotation>"
        f"<translation>{' '.join(map(repr, map(float, shift)))}</translation><scale>{scale}</scale></transform>"
    )
    path = folder / "cameras.xml"
    path.write_text(
        f'<?xml version="1.0"?><document version="2.0.0"><chunk label="Chunk 1"><sensors><sensor id="7" type="{kind}">'
        f'{size}<calibration class="initial">{size}<f>1</f></calibration><calibration class="adjusted">{size}{shown}'
        f'</calibration></sensor></sensors><components><component id="0">{moved}</component></components>'
        f"<cameras><group>{cameras}</group></cameras><reference>{reference}</reference></chunk></document>"
    )
    return folder


def metashape_formula(view: room.View, numbers: dict[str, float], points: np.ndarray, fisheye: bool) -> np.ndarray:
    """The manual's appendix: frame and fisheye cameras."""
    n, local = {**NONE, **numbers}, (points - view.eye) @ axes(view)
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    if fisheye:
        r0 = np.sqrt(x**2 + y**2)
        x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
    r = np.sqrt(x**2 + y**2)
    radial = 1 + n["k1"] * r**2 + n["k2"] * r**4 + n["k3"] * r**6 + n["k4"] * r**8
    x1 = x * radial + n["p1"] * (r**2 + 2 * x**2) + 2 * n["p2"] * x * y
    y1 = y * radial + n["p2"] * (r**2 + 2 * y**2) + 2 * n["p1"] * x * y
    u = SIZE[0] * 0.5 + (LENS.cx - SIZE[0] / 2) + x1 * LENS.fx + x1 * n["b1"] + y1 * n["b2"]
    return np.stack([u, SIZE[1] * 0.5 + (LENS.cy - SIZE[1] / 2) + y1 * LENS.fx], axis=-1)


def projected(capture: Capture, index: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of points as the reader's camera and lens show them, and which of them are before the camera."""
    shot = next(shot for shot in capture.shots if shot.name == f"IMG_{index}")
    lens, local = shot.camera, (points - shot.camera.centre) @ shot.camera.camera_to_world[:3, :3]
    ahead = local[:, 2] > 0.2
    x, y = shot.distortion.bent(*(local[ahead, :2] / local[ahead, 2:]).T)
    pixels = np.stack([x * lens.fx + lens.cx, y * lens.fy + lens.cy], axis=-1)
    return pixels, ahead


def inside(pixels: np.ndarray) -> np.ndarray:
    return ((pixels > -20) & (pixels < np.array(SIZE) + 20)).all(axis=1)


@pytest.mark.parametrize("kind", ["frame", "fisheye"])
def test_metashape_cameras_project_as_its_manual_says(tmp_path: Path, kind: str) -> None:
    capture = metashape.FORMAT.read(metashape_xml(tmp_path, BENT, kind), unwatched)
    assert capture.lost == ["IMG_2"] and [each.names for each in capture.left_out] == [("IMG_4",)]
    for i in (0, 1, 3, 5):
        pixels, ahead = projected(capture, i, POINTS)
        expected = metashape_formula(room.elsewhere(room.views()[i]), BENT, POINTS[ahead], kind == "fisheye")
        near = inside(expected)
        assert near.sum() >= 20 and np.abs(pixels - expected)[near].max() < 0.01


def test_metashape_distortion_is_opencvs_with_p1_and_p2_swapped(tmp_path: Path) -> None:
    """A second reader: OpenCV's own projection."""
    numbers = {name: BENT[name] for name in ("k1", "k2", "k3", "p1", "p2", "b1")}
    capture = metashape.FORMAT.read(metashape_xml(tmp_path, numbers), unwatched)
    view = room.elsewhere(room.views()[0])
    pixels, ahead = projected(capture, 0, POINTS)
    matrix = np.array([[LENS.fx + BENT["b1"], 0, LENS.cx], [0, LENS.fx, LENS.cy], [0, 0, 1]])
    lens = np.array([BENT["k1"], BENT["k2"], BENT["p2"], BENT["p1"], BENT["k3"]])
    turned = axes(view).T
    expected, _ = cv2.projectPoints(POINTS[ahead], cv2.Rodrigues(turned)[0], -turned @ view.eye, matrix, lens)
    near = inside(expected[:, 0])
    assert near.sum() >= 20 and np.abs(pixels - expected[:, 0])[near].max() < 0.01


def test_a_georeferenced_metashape_scene_is_moved_to_the_origin(tmp_path: Path) -> None:
    capture = metashape.FORMAT.read(metashape_xml(tmp_path, NONE, reference='GEOGCS["WGS 84"]'), unwatched)
    centres = np.array([shot.camera.centre for shot in capture.shots])
    eyes = np.array([room.elsewhere(room.views()[i]).eye for i in (0, 1, 3, 5)])
    np.testing.assert_allclose(centres, eyes, atol=1e-5)  # east, north and up stay what they were in the room


@pytest.mark.parametrize(
    ("was", "now", "told"),
    [
        ('type="frame"', 'type="spherical"', "lens-model spherical"), ("<f>", "<fx>", "not-xml damaged"),
        ("</f>", "</f><p3>0.1</p3>", "lens-model P3"), ("<?xml", "<!DOCTYPE a><?xml", "xml-entities"),
        ('<scale>0.5', "<scale>half", "xml-numbers scale"), ("IMG_", "DSC_", "no-pictures DSC"),
        ("<scale>0.5", "<scale>0", "xml-numbers positive"), ("<scale>0.5", "<scale>-0.5", "xml-numbers positive"),
    ],
)  # fmt: skip
def test_unsupported_metashape_files_give_a_one_line_error(tmp_path: Path, was: str, now: str, told: str) -> None:
    path = metashape_xml(tmp_path, NONE) / "cameras.xml"
    path.write_text(path.read_text().replace(was, now))
    with raises_key(told):
        open_scene(tmp_path)


def reality_csv(folder: Path, numbers: dict[str, float], views: list[room.View] | None = None) -> Path:
    """``views``: where the cameras stand, by default in a world that is not upright."""
    n = {**NONE, **numbers}
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for i, view in enumerate(photos(folder) if views is None else (photos(folder), views)[1]):
        # The inverse of Rz(-heading) Rx(pitch) Ry(roll), whose columns are right, up and back.
        turn = np.stack([view.right, view.up, -view.forward], axis=-1)
        pitch, roll = np.arcsin(turn[2, 1]), np.arctan2(-turn[2, 0], turn[2, 2])
        heading = np.arctan2(turn[0, 1], turn[1, 1])
        angles = np.rad2deg([heading, pitch, roll])
        middle = (LENS.cx - SIZE[0] / 2) / max(SIZE), (LENS.cy - SIZE[1] / 2) / max(SIZE)
        values = [*view.eye, *angles, LENS.fx * 36 / max(SIZE), *middle, *(n[k] for k in ("k1", "k2", "k3", "k4"))]
        lines.append(",".join([f"IMG_{i}.png", *(f"{value:.12g}" for value in (*values, n["t1"], n["t2"]))]))
    (folder / "registration.csv").write_text("\n".join(lines) + "\n")
    return folder


def converted(row: dict[str, float], points: np.ndarray) -> np.ndarray:
    """nerfstudio's conversion (realitycapture_utils.py, as of its pull request 3131), then its OPENCV lens."""
    yaw, pitch, roll = np.deg2rad([-row["heading"], row["pitch"], row["roll"]])
    rot_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    rot_y = np.array([[np.cos(roll), 0, np.sin(roll)], [0, 1, 0], [-np.sin(roll), 0, np.cos(roll)]])
    rot_z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    opengl = (points - [row["x"], row["y"], row["alt"]]) @ (rot_z @ rot_x @ rot_y)
    x, y = opengl[:, 0] / -opengl[:, 2], -opengl[:, 1] / -opengl[:, 2]
    r2 = x * x + y * y
    radial = 1 + r2 * (row["k1"] + r2 * (row["k2"] + r2 * (row["k3"] + r2 * row["k4"])))
    u = x * radial + 2 * row["t1"] * x * y + row["t2"] * (r2 + 2 * x * x)
    v = y * radial + 2 * row["t2"] * x * y + row["t1"] * (r2 + 2 * y * y)
    focal = row["f"] * max(SIZE) / 36
    middle = np.array([row["px"], row["py"]]) * max(SIZE) + np.array(SIZE) / 2
    return np.stack([u, v], axis=-1) * focal + middle


def test_realityscan_cameras_project_as_its_converters_say(tmp_path: Path) -> None:
    numbers = {"k1": -0.2, "k2": 0.07, "k3": -0.01, "k4": 0.002, "t1": 0.002, "t2": -0.001}
    folder = reality_csv(tmp_path, numbers)
    lines = [line.split(",") for line in (folder / "registration.csv").read_text().splitlines()]
    capture = reality.FORMAT.read(folder, unwatched)
    for i, line in enumerate(lines[1:]):
        row = {name: float(value) for name, value in zip(lines[0][1:], line[1:], strict=True)}
        pixels, ahead = projected(capture, i, POINTS)
        expected = converted(row, POINTS[ahead])
        near = inside(expected)
        assert near.sum() >= 20 and np.abs(pixels - expected)[near].max() < 0.01


def test_a_word_among_the_numbers_of_a_realityscan_table_is_refused(tmp_path: Path) -> None:
    table = reality_csv(tmp_path, NONE, views=room.views()) / "registration.csv"
    table.write_text(table.read_text().replace("IMG_3.png,", "IMG_3.png,far"))
    assert refuses("not-numbers IMG_3", tmp_path).fix.startswith("Export Registration")


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("IMG_3.png,,0,1,0,90,0,30", "not-numbers x of IMG_3"), ("IMG_3.png,0,0", "not-numbers IMG_3"),
        (f"IMG_3.png,{'9' * 140_000}", "not-csv limit"),
    ],
)  # fmt: skip
def test_a_damaged_row_of_realityscans_table_gives_a_one_line_error(tmp_path: Path, line: str, told: str) -> None:
    table = reality_csv(tmp_path, NONE, views=room.views()) / "registration.csv"
    rows = table.read_text().splitlines()
    table.write_text("\n".join(line if row.startswith("IMG_3") else row for row in rows))
    refuses(told, tmp_path)


def bundle(folder: Path, has_list: bool = True) -> Path:
    """Bundler's cameras look along -z with y up; their principal point is the picture's middle."""
    centred = replace(LENS, cx=SIZE[0] / 2, cy=SIZE[1] / 2, fy=LENS.fx)
    views, marks = photos(folder), []
    text = f"# Bundle file v0.3\n{len(views)} {len(views)}\n"
    for i, (view, plain) in enumerate(zip(views, room.views(), strict=True)):
        room.write_colour(folder / "images" / f"IMG_{i}.png", room.look(plain, centred).colour)
        rows = np.stack([view.right, view.up, -view.forward])
        marks.append(view.eye + 1.5 * view.forward)
        focal = 0.0 if i == 2 else LENS.fx
        text += f"{focal} -0.2 0.05\n" if i else f"{focal} 0 0\n"
        text += "\n".join(" ".join(f"{v:.12g}" for v in row) for row in (*rows, -rows @ view.eye)) + "\n"
    for i, mark in enumerate(marks):
        text += f"{' '.join(f'{v:.12g}' for v in mark)}\n9 8 7\n1 {i} 0 0.0 0.0\n"
    (folder / "bundle.out").write_text(text)
    if has_list:
        (folder / "list.txt").write_text("".join(f"images/IMG_{i}.png 0 {LENS.fx}\n" for i in range(len(views))))
    return folder


@pytest.mark.parametrize("has_list", [True, False])
def test_bundler_cameras_project_as_its_manual_says(tmp_path: Path, has_list: bool) -> None:
    capture = bundler.FORMAT.read(bundle(tmp_path, has_list), unwatched)
    assert capture.lost == ["IMG_2"]
    assert any(each.about == "numbering" for each in capture.inferred) is not has_list
    for i in (0, 1, 3):
        view = room.elsewhere(room.views()[i])
        pixels, ahead = projected(capture, i, POINTS)
        local = (POINTS[ahead] - view.eye) @ np.stack([view.right, view.up, -view.forward]).T
        p = -local[:, :2] / local[:, 2:]
        k1, k2 = (-0.2, 0.05) if i else (0.0, 0.0)
        square = (p**2).sum(axis=1, keepdims=True)
        p = LENS.fx * (1 + k1 * square + k2 * square**2) * p
        expected = np.stack([SIZE[0] / 2 + p[:, 0], SIZE[1] / 2 - p[:, 1]], axis=-1)
        near = inside(expected)
        assert near.sum() >= 20 and np.abs(pixels - expected)[near].max() < 0.01


def test_bundler_points_project_into_the_pictures_that_saw_them(tmp_path: Path) -> None:
    scene = open_scene(bundle(tmp_path))
    assert scene.format == "bundler" and scene.points is not None and scene.points.rgb[0].tolist() == [9, 8, 7]
    for frame in scene.frames:
        pixel, depth = frame.camera.project(scene.points.xyz[scene.points.seen_by[frame.name]])
        np.testing.assert_allclose([*pixel[0], depth[0]], [SIZE[0] / 2, SIZE[1] / 2, 1.5], atol=1e-5)
    whole = (tmp_path / "bundle.out").read_text()
    (tmp_path / "bundle.out").write_text(whole[:-30])
    refuses("cut-off", tmp_path)
    (tmp_path / "list.txt").unlink()
    (tmp_path / "images" / "IMG_5.png").unlink()
    refuses("no-list list.txt", tmp_path)


@pytest.mark.parametrize(
    ("was", "now", "told"),
    [
        ("\n6 6\n", "\ninf 6\n", "not-bundler"), ("\n6 6\n", "\n6 inf\n", "not-bundler"),
        ("\n1 0 0 ", "\nnan 0 0 ", "not-numbers"), ("\n1 0 0 ", "\ninf 0 0 ", "not-numbers"),
        ("\n1 0 0 ", "\n1 nan 0 ", "not-numbers"), ("\n9 8 7\n1 0 ", "\n9 8 nan\n1 0 ", "not-numbers"),
    ],
)  # fmt: skip
def test_bad_numbers_in_a_bundler_file_give_a_one_line_error(tmp_path: Path, was: str, now: str, told: str) -> None:
    path = bundle(tmp_path) / "bundle.out"
    text = path.read_text()
    assert was in text
    path.write_text(text.replace(was, now))
    refuses(told, tmp_path)


def test_a_flat_colmap_export_of_realityscan_is_read(tmp_path: Path) -> None:
    """Its *COLMAP* export may put the model beside the pictures, with the lens that OpenCV calls full."""
    views = photos(tmp_path)
    numbers = (LENS.fx, LENS.fx, LENS.cx, LENS.cy, -0.2, 0.07, 0.002, -0.001, -0.01, 0.0, 0.0, 0.0)
    (tmp_path / "cameras.txt").write_text(f"1 FULL_OPENCV {SIZE[0]} {SIZE[1]} {' '.join(map(repr, numbers))}\n")
    lines = []
    for i, view in enumerate(views):
        rows = axes(view).T
        q, t = room.quaternion(rows), -rows @ view.eye
        lines.append(f"{i + 1} {' '.join(f'{v:.12g}' for v in (*q, *t))} 1 IMG_{i}.png\n\n")
        (tmp_path / "images" / f"IMG_{i}.png").rename(tmp_path / f"IMG_{i}.png")
    (tmp_path / "images.txt").write_text("".join(lines))
    (tmp_path / "points3D.txt").write_text("")
    from engine.scene.formats import colmap

    capture = colmap.FORMAT.read(tmp_path, unwatched)
    matrix = np.array([[LENS.fx, 0, LENS.cx], [0, LENS.fx, LENS.cy], [0, 0, 1]])
    for i, view in enumerate(views):
        pixels, ahead = projected(capture, i, POINTS)
        rows = axes(view).T
        lens = np.array(numbers[4:])
        expected, _ = cv2.projectPoints(POINTS[ahead], cv2.Rodrigues(rows)[0], -rows @ view.eye, matrix, lens)
        near = inside(expected[:, 0])
        assert near.sum() >= 20 and np.abs(pixels - expected[:, 0])[near].max() < 0.01
