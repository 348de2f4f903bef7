"""``transforms.json`` of nerfstudio and instant-ngp.

``frames[].file_path`` and ``transform_matrix``, camera-to-world, OpenGL axes. ``fl_x fl_y cx cy w h`` or
``camera_angle_x``, and the distortion ``k1 k2 k3 k4 p1 p2`` with ``camera_model``, for all frames or for each; pixel
centres at +0.5. ``depth_file_path`` (nerfstudio) or ``depth_path`` (instant-ngp): planar depth as 16-bit PNG, in
millimetres or steps of ``integer_depth_scale`` or ``depth_unit_scale_factor``, or as .npy in metres.
``ply_file_path``: the points of the reconstruction. ``mask_path``: pixels that do not count are black. Frames with
``is_bad`` are left out.

``train_filenames`` and ``test_filenames`` (or ``val_filenames``) give the split, or ``test_frames`` holds the frames
that are held out, or ``transforms_test.json`` (or ``_val``) beside ``transforms_train.json`` (NeRF's synthetic scenes).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...json_file import read_json_object, take_list, take_number, take_objects, take_text, wrong_type
from ...posed.frames import Camera
from ...posed.image_header import read_image_header
from ...posed.layout import check_count, file_inside, natural_order, read_file
from ...posed.matrices import take_array
from ...posed.plain_folders import Split
from ...posed.ply import ply_header
from ...scene_source import UpAxis
from ..depth import MILLIMETRES, DepthMap, npy_depth, png_depth
from ..frame import Inferred, Size, SparsePoints, left_out
from ..pixels import label_header
from .capture import Capture, Progress, SceneFormat, Shot, frame_names, watched, with_picture
from .lens import LENS_NUMBER, Distortion, fitted, of_nerfstudio, pinhole
from .poses import finite_pose, from_opengl

_FILE, _TRAIN = "transforms.json", "transforms_train.json"
_HELD_OUT = ("transforms_test.json", "transforms_val.json")
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "perspective", "")
_OPENCV, _FISHEYE = ("OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV"), "OPENCV_FISHEYE"
_IS_HELD_OUT, _SPLIT = "of test_frames", ("train_filenames", "val_filenames", "test_filenames")
_IMAGES = (".png", ".jpg", ".jpeg")
_CENTRED = Inferred(
    "principal point", "the principal point of the lens is assumed in the middle", "write cx and cy if it is not there"
)


def _files(place: Path) -> list[Path]:
    """Return the files with the frames: one for all, or one for training and one held out."""
    if place.is_file():
        return [place] if place.name in (_FILE, _TRAIN) else []
    held_out = [place / name for name in _HELD_OUT if (place / name).is_file()][:1]
    is_split = not (place / _FILE).is_file() and (place / _TRAIN).is_file()
    return [place / _TRAIN, *held_out] if is_split else [place / _FILE]


def _read(place: Path, progress: Progress) -> Capture:
    paths = _files(place) or [place]
    contents = [read_json_object(path) for path in paths]
    parts = [_frames(content, path) for content, path in zip(contents, paths, strict=True)]
    names = frame_names([frame["file_path"] for frames, _ in parts for frame in frames])
    of_parts = np.split(np.array(names, object), np.cumsum([len(frames) for frames, _ in parts])[:-1])
    entries = dict(zip(names, (frame for frames, _ in parts for frame in frames), strict=True))
    bad = {name: frame for name, frame in entries.items() if frame.get("is_bad") is True}
    found = [
        (name, with_picture(_image_path(path, frame["file_path"]), partial(_shot, name, {**content, **frame}, path)))
        for own, (frames, _), content, path in zip(of_parts, parts, contents, paths, strict=True)
        for name, frame in watched([*zip(own, frames, strict=True)], progress)
        if name not in bad
    ]
    missing = [name for _, absent in parts for name in absent]
    said = ({**content, **frame} for content, (frames, _) in zip(contents, parts, strict=True) for frame in frames)
    is_centred = any("fl_x" in entry and not ("cx" in entry and "cy" in entry) for entry in said)
    up: UpAxis | None = "z" if contents[0].get("orientation_override") == "none" else None
    posed = {name for name, shot in found if isinstance(shot, Shot)}
    points = None
    if contents[0].get("ply_file_path"):
        ply = file_inside(paths[0].parent, take_text(contents[0], "ply_file_path", "the file", paths[0]), paths[0])
        points = read_ply_points(ply) if ply.is_file() else None
        if points is not None:
            points = replace(points, xyz=points.xyz / _applied_scale(contents[0], paths[0]))
    kept = [tuple(name for name in own if name in posed) for own in of_parts]
    own = {name: frame for name, frame in entries.items() if name in posed}
    split = Split(*kept) if len(kept) == 2 else _own_split(contents[0], own, paths[0])
    unused = posed.difference(split.train, split.test) if split is not None else set[str]()
    return Capture(
        found, up, (), points, split,
        left_out=(
            *left_out("a picture", missing), *left_out("a good picture (is_bad)", bad),
            *left_out("a place in the file's split", sorted(unused, key=natural_order)),
        ),
        inferred=(_CENTRED,) if is_centred else (),
    )  # fmt: skip


def _own_split(content: dict[str, Any], frames: Mapping[str, Mapping[str, Any]], path: Path) -> Split | None:
    names = {_plain(frame["file_path"]): name for name, frame in frames.items()}
    listed = dict[str, set[str]]()
    for key in filter(content.get, _SPLIT):
        files = take_list(content, key, "the file", path)
        if not all(isinstance(file, str) for file in files):
            raise wrong_type(key, "a list of files", files, "the file", path)
        listed[key] = {names[_plain(file)] for file in files if _plain(file) in names}  # others have no frame
    marked = {name for name, frame in frames.items() if frame.get(_IS_HELD_OUT)}
    held_out = listed.get("test_filenames") or listed.get("val_filenames") or marked
    if not held_out and "train_filenames" in listed:
        held_out = frames.keys() - listed["train_filenames"]
    train = {name for name in listed.get("train_filenames", frames) if name not in held_out}
    if not held_out:
        return None
    if not train:
        fix = "Hold out fewer frames, or name others in train_filenames."
        raise PlgsError("no-training-frame", "no frame is left to train on", path, fix)
    return Split(tuple(name for name in frames if name in train), tuple(name for name in frames if name in held_out))


def _plain(file: str) -> str:
    return "/".join(part for part in file.replace("\\", "/").split("/") if part not in ("", "."))


def _frames(content: dict[str, Any], path: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the frames whose pictures exist, in natural order, and the names of pictures that do not exist."""
    frames = take_objects(content, "frames", "the file", path)
    if "test_frames" in content:
        frames += [{**frame, _IS_HELD_OUT: True} for frame in take_objects(content, "test_frames", "the file", path)]
    for frame in frames:
        take_text(frame, "file_path", "a frame", path)  # only to raise before they are sorted by it
    frames.sort(key=lambda frame: natural_order(frame["file_path"]))
    present = [frame for frame in frames if _image_path(path, frame["file_path"]).is_file()]
    absent = [frame["file_path"] for frame in frames if frame not in present]
    if frames and not present:
        what = "the pictures are missing"
        raise PlgsError("no-pictures", what, _image_path(path, frames[0]["file_path"]), "Copy them there.")
    return present, absent


def _shot(name: str, frame: Mapping[str, Any], path: Path) -> Shot | None:
    """Return one frame. Keys that its entry lacks are taken from the file's. None if its pose is not finite."""
    entry, context = dict(frame), f"frame {name}"
    pose = finite_pose(take_array(entry, "transform_matrix", context, path, (4, 4), (3, 4)), path)
    if pose is None:
        return None
    colour_path = _image_path(path, frame["file_path"])
    lens = _lens(entry, read_image_header(colour_path).size, context, path)
    lens = fitted(lens, colour_path, f"Correct w and h of {context} in {path.name}.")
    depth = _depth(entry, lens, context, path)
    pose[:3, 3] /= _applied_scale(entry, path)
    camera = lens.at(from_opengl(pose))
    kept = None
    if entry.get("mask_path"):
        kept = file_inside(path.parent, take_text(entry, "mask_path", context, path), path)
        label_header(kept)  # only to raise now rather than in the middle of a lift
    return Shot(name, camera, colour_path, depth, distortion=_distortion(entry, context, path), kept_pixels=kept)


def _applied_scale(entry: dict[str, Any], path: Path) -> float:
    """Return the factor by which the file's poses and points were multiplied. Its depth, in metres, was not."""
    if "applied_scale" not in entry:
        return 1.0
    return take_number(entry, "applied_scale", "the file", path, least=1e-6, most=1e6)


def _image_path(path: Path, name: str) -> Path:
    """The image called ``file_path``; some writers omit its suffix. Raises PlgsError if it is outside the folder."""
    plain = name.replace("\\", "/")
    try:
        image = file_inside(path.parent, name, path)
    except PlgsError:
        if (beside := _beside(path, plain)) is None:
            raise
        return beside
    found = (image.with_name(image.name + suffix) for suffix in ("", *_IMAGES))
    return next((each for each in found if each.is_file()), None) or _beside(path, plain) or image


def _beside(path: Path, name: str) -> Path | None:
    """Find an image whose name is relative to another folder: return the file below the JSON's folder that the last
    parts of its name give, None if there is none."""
    parts = [part for part in name.split("/") if part not in ("", ".", "..")]
    tails = (path.parent.joinpath(*parts[start:]) for start in range(1, len(parts)))
    paths = (tail.with_name(tail.name + suffix) for tail in tails for suffix in ("", *_IMAGES))
    found = next((each for each in paths if each.is_file()), None)
    return None if found is None else file_inside(path.parent, str(found.relative_to(path.parent)), path)


def _lens(entry: dict[str, Any], size: Size, context: str, path: Path) -> Camera:
    """Return a camera at the origin, of the intrinsics' own size. Raises PlgsError if ``entry`` has no intrinsics."""
    width, height = (
        take_number(entry, key, context, path) if key in entry else float(side)
        for key, side in zip("wh", size, strict=True)
    )
    if "fl_x" in entry or "camera_angle_x" not in entry:  # with neither, the error names fl_x
        fx = take_number(entry, "fl_x", context, path)
    else:
        fx = _focal_length(entry, "camera_angle_x", width, context, path)
    if "fl_y" in entry:
        fy = take_number(entry, "fl_y", context, path)
    elif "camera_angle_y" in entry and "fl_x" not in entry:
        fy = _focal_length(entry, "camera_angle_y", height, context, path)
    else:
        fy = fx  # square pixels
    cx = take_number(entry, "cx", context, path) if "cx" in entry else width / 2.0
    cy = take_number(entry, "cy", context, path) if "cy" in entry else height / 2.0
    return pinhole(width, height, fx, fy, cx, cy, path=path, fix="Correct w, h, fl_x, fl_y, cx and cy.", whose=context)


def _focal_length(entry: dict[str, Any], key: str, side: float, context: str, path: Path) -> float:
    angle = take_number(entry, key, context, path)
    if not 0.0 < angle < math.pi:
        raise PlgsError("bad-angle", f'"{key}" of {context} is not an angle of view in radians', path, "Correct it.")
    return side / 2.0 / math.tan(angle / 2.0)


def _distortion(entry: dict[str, Any], context: str, path: Path) -> Distortion:
    model = entry.get("camera_model", "OPENCV")
    if model not in (*_PINHOLES, *_OPENCV, _FISHEYE):
        fix = "Undistort the pictures, and give PINHOLE, OPENCV or OPENCV_FISHEYE."
        what = f'{context} has the camera model "{str(model)[:40]}", which is not known'
        raise PlgsError("lens-model", what, path, fix)
    flags = ("latlong", "equirectangular")
    named = {
        key: float(value is True) if key in flags else take_number(entry, key, context, path)
        for key, value in entry.items()
        if LENS_NUMBER.fullmatch(key)
    }
    try:
        return of_nerfstudio(named, model, model == _FISHEYE or entry.get("is_fisheye") is True)
    except ValueError as error:
        what = f"{context} has coefficients of an unknown lens ({error})"
        raise PlgsError("lens-numbers", what, path, "Undistort the pictures, and remove these coefficients.") from error


def _depth(entry: dict[str, Any], lens: Camera, context: str, path: Path) -> DepthMap | None:
    key = next((key for key in ("depth_file_path", "depth_path") if entry.get(key)), None)
    if key is None:
        return None
    depth_path = file_inside(path.parent, take_text(entry, key, context, path), path)
    is_array = depth_path.suffix.lower() == ".npy"
    if not depth_path.suffix and not depth_path.is_file():
        depth_path = depth_path.with_name(depth_path.name + ".png")
    scale = next((key for key in ("integer_depth_scale", "depth_unit_scale_factor") if key in entry), None)
    unit = MILLIMETRES if scale is None else take_number(entry, scale, context, path)
    if is_array and scale is None:
        return npy_depth(depth_path)
    if not 0.0 < unit < 1.0 and not (is_array and unit == 1.0):
        fix = "Write one such as 0.001; or give 16-bit depth from another source with --depth MAPS."
        raise PlgsError("bad-scale", f'"{scale}" is not one depth step in metres', path, fix, option="--depth")
    return npy_depth(depth_path, unit) if is_array else png_depth(depth_path, lens, unit)


FORMAT = SceneFormat("nerfstudio", lambda place: any(path.is_file() for path in _files(place)), _read)


_MOST_BYTES = 1 << 30
_MOST_IN_TEXT = 1_000_000  # maximum number of vertices as text, which take some seconds
_VERTEX_IN_MEMORY, _VALUE_IN_MEMORY = 48, 200  # bytes for a coloured vertex, and for a number as text
_SHORT = "Write this file again."
_PLY_FIX = "Write a PLY whose first element is vertex, with x, y, z."


def read_ply_points(path: Path) -> SparsePoints:
    """Read a PLY's vertices (ASCII or binary) as points, white without colours. Raises PlgsError for other files."""
    data = read_file(path, _MOST_BYTES)
    header = ply_header(data)
    if not header.end:
        raise PlgsError("not-ply", "this is not a PLY file", path, _PLY_FIX)
    first, (count, columns) = next(iter(header.elements.items()), ("", (0, dict[str, str]())))
    if first != "vertex":
        raise PlgsError("ply-vertices", "the PLY does not begin with vertices", path, _PLY_FIX)
    if "" in columns.values():
        what = "the PLY's vertices have a property that is not understood, or have one twice"
        raise PlgsError("ply-property", what, path, _PLY_FIX)
    if not {"x", "y", "z"} <= columns.keys():
        raise PlgsError("ply-positions", "the PLY's vertices have no x, y and z", path, _PLY_FIX)
    order = ">" if header.form == "binary_big_endian" else "<"
    fields = np.dtype([(name, order + kind) for name, kind in columns.items()])
    vertices = _vertices(data[header.end :], header.form, count, fields, path)
    xyz = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    rgb = np.full((count, 3), 255, np.uint8)
    if {"red", "green", "blue"} <= columns.keys():
        rgb = np.stack([vertices[name].astype(np.uint8) for name in ("red", "green", "blue")], axis=-1)
    good = np.isfinite(xyz).all(-1)
    return SparsePoints(xyz[good], rgb[good])


def _vertices(body: bytes, form: str, count: int, fields: np.dtype[np.void], path: Path) -> NDArray[np.void]:
    if form != "ascii":
        room = len(body) // fields.itemsize
        check_count(count, "vertices", path, _SHORT, most=_MOST_BYTES, room=room, made=_VERTEX_IN_MEMORY)
        return np.frombuffer(body, fields, count)
    values = len(fields.names or ())
    room = len(body) // (2 * values)  # a digit and what separates it from the next
    made = values * _VALUE_IN_MEMORY
    check_count(
        count, "vertices as text", path, "Write it as a whole, as binary.", most=_MOST_IN_TEXT, room=room, made=made
    )
    rows = [line.decode("ascii", "replace").split() for line in body.split(b"\n", count)[:count]]
    check_count(count, "vertices", path, _SHORT, most=count, room=len(rows), made=0)
    try:
        return np.array([tuple(float(value) for value in row) for row in rows], fields)
    except (ValueError, OverflowError) as error:
        raise PlgsError("ply-not-numbers", "the PLY's vertices are not numbers", path, _PLY_FIX) from error
