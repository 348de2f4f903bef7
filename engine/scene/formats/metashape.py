"""Agisoft Metashape's cameras (*Export Cameras*, XML) beside their photos.

Its manual, appendix "Camera models": a camera's transform takes points to its chunk, with OpenCV's axes; that of its
component, or of the chunk, to the world. Pixels' centres are at +0.5, and cx and cy count from the picture's middle.
P1 and P2 change places against OpenCV; B1 is how much longer fx is than f, and B2 the skew. A fisheye has the same
formula for angles. Where the project has geographic coordinates, the world is the Earth, with its centre in the origin.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...gates import open_plain
from ...json_file import LARGEST_TABLE
from ...posed.frames import Camera, as_pose
from ...posed.layout import listed, read_text, shown_files
from ..frame import left_out
from .capture import Capture, ListedCamera, Progress, SceneFormat, Shot, shots_of
from .lens import Distortion, fitted, pinhole
from .photos import picture_of, pictures_by_stem
from .poses import finite_pose

_FIX = "Choose File > Export > Export Cameras in Metashape once more, with the format Agisoft XML."
_BEGINNING = 4096  # bytes that are looked at for Metashape's elements
_ON_EARTH = ("GEOGCS", "PROJCS", "GEOCCS", "COMPD_CS")  # how coordinate systems of the Earth begin in a project
# What gives a project metres.
_MEASURED = ("scalebars/scalebar", "markers/marker/reference", "cameras//camera/reference")
Array = NDArray[np.float64]


class _World(NamedTuple):
    """The transform from a chunk's points to the world: ``rotation`` [3, 3], ``translation`` [3], ``scale``."""

    rotation: Array
    translation: Array
    scale: float


def _file(place: Path) -> Path | None:
    """Return the file with Metashape's cameras: ``place`` itself, or the first one in that folder; None without one."""
    files = [place] if place.is_file() else sorted(shown_files(place, "*.xml"))
    return next((each for each in files if each.suffix.lower() == ".xml" and each.is_file() and _is_its(each)), None)


def _is_its(path: Path) -> bool:
    try:
        with open_plain(path) as file:
            head = file.read(_BEGINNING)
    except OSError:
        return False
    return b"<document" in head and b"<chunk" in head


def _read(place: Path, progress: Progress) -> Capture:
    path = _file(place)
    if path is None:
        raise PlgsError("no-metashape", "there is no XML with Metashape's cameras", place, _FIX)
    chunk, warnings = _chunk(path)
    lenses = {each.get("id"): each for each in chunk.findall("sensors/sensor")}
    placed = {each.get("id"): _world(each.find("transform"), path) for each in chunk.findall("components/component")}
    placed[None] = _world(chunk.find("transform"), path)
    worlds = {name: world for name, world in placed.items() if world is not None}
    on_earth = bool(worlds) and (chunk.findtext("reference") or "").lstrip().startswith(_ON_EARTH)
    if on_earth:
        centre = next(iter(worlds.values())).translation
        worlds = {name: _on_the_ground(world, centre) for name, world in worlds.items()}
    cameras = [*chunk.iter("camera")]
    disabled = [each.get("label", "") for each in cameras if each.get("enabled", "1").lower() in ("0", "false")]
    used = [each for each in cameras if each.get("enabled", "1").lower() not in ("0", "false")]
    photos = pictures_by_stem(path.parent)
    listed_cameras = list[ListedCamera]()
    for camera in used:
        label = camera.get("label", "")
        picture = picture_of(photos, label)
        world, sensor = worlds.get(camera.get("component_id"), worlds.get(None)), lenses.get(camera.get("sensor_id"))
        make = None if camera.find("transform") is None else partial(_shot, camera, sensor, world, path)
        listed_cameras.append((label if picture is None else picture.stem, picture, make))
    found, missing = shots_of(listed_cameras, path.parent, progress)
    is_measured = bool(worlds) and any(chunk.find(each) is not None for each in _MEASURED)
    return Capture(
        found, "z" if is_measured or on_earth else None, tuple(warnings),
        left_out=(*missing, *left_out("being enabled in Metashape", disabled)),
        has_unit=is_measured or on_earth, up_is_known=on_earth,
    )  # fmt: skip


def _chunk(path: Path) -> tuple[ElementTree.Element, list[str]]:
    """Return the first chunk that has cameras, and warnings. Raises PlgsError if the file has none."""
    text = read_text(path, LARGEST_TABLE, _FIX)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # a few lines of these unpack to any size
        raise PlgsError("xml-entities", "the XML defines entities, as Metashape never does", path, _FIX)
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise PlgsError("not-xml", f"the XML is damaged ({error})", path, _FIX) from error
    chunks = [each for each in root.iter("chunk") if next(each.iter("camera"), None) is not None]
    if not chunks:
        raise PlgsError("no-cameras-in-xml", "there are no cameras in this file", path, _FIX)
    others = [each.get("label", "?") for each in chunks[1:]]
    return chunks[0], [f"only the first chunk is read, but there are others: {listed(others)}"] if others else []


def _numbers(element: ElementTree.Element | None, count: int, what: str, path: Path) -> Array:
    text = "" if element is None else element.text or ""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise PlgsError("xml-numbers", f"{what} must have {count} numbers", path, _FIX)
    return values


def _world(transform: ElementTree.Element | None, path: Path) -> _World | None:
    if transform is None or transform.find("rotation") is None:
        return None
    rotation = _numbers(transform.find("rotation"), 9, "a chunk's rotation", path).reshape(3, 3)
    translation = _numbers(transform.find("translation"), 3, "a chunk's translation", path)
    scale = float(_numbers(transform.find("scale"), 1, "a chunk's scale", path)[0])
    if scale <= 0.0:
        raise PlgsError("xml-numbers", "a chunk's scale is not positive", path, _FIX)
    return _World(rotation, translation, scale)


def _shot(
    camera: ElementTree.Element, sensor: ElementTree.Element | None, world: _World | None, path: Path, picture: Path
) -> Shot | None:
    pose = _numbers(camera.find("transform"), 16, f"the transform of {picture.name}", path).reshape(4, 4)
    if world is not None:
        turned = world.rotation @ pose[:3, :3]
        pose = as_pose(turned, world.scale * world.rotation @ pose[:3, 3] + world.translation)
    if sensor is None:
        raise PlgsError("no-camera", f"{picture.name} has a sensor that is missing", path, _FIX)
    lens, distortion = _lens(sensor, path)
    rigid = finite_pose(pose, path)
    lens = fitted(lens, picture, "Give the photos that are in the project.")
    return None if rigid is None else Shot(picture.stem, lens.at(rigid), picture, distortion=distortion)


def _lens(sensor: ElementTree.Element, path: Path) -> tuple[Camera, Distortion]:
    """Return a sensor's camera at the origin, and its distortion, from its adjusted calibration."""
    kind, whose = sensor.get("type", "frame"), f'the sensor "{sensor.get("label", "")}"'
    found = {each.get("class", "adjusted"): each for each in sensor.findall("calibration")}
    calibration = found.get("adjusted", found.get("initial"))
    if kind not in ("frame", "fisheye") or calibration is None or calibration.find("f") is None:
        what = f"{whose} is {kind}" if kind not in ("frame", "fisheye") else f"{whose} has no calibration"
        fix = "Export cameras of frame or fisheye sensors, aligned, from Metashape 1.3 or newer."
        raise PlgsError("lens-model", what, path, fix)
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    side = {} if size is None else size.attrib
    named = {each.tag: each for each in calibration if each.tag != "resolution"}

    def value(name: str) -> float:
        return float(_numbers(named[name], 1, f"{name} of {whose}", path)[0]) if name in named else 0.0

    try:
        width, height = float(side["width"]), float(side["height"])
    except (KeyError, ValueError) as error:
        raise PlgsError("xml-numbers", f"{whose} has no resolution", path, _FIX) from error
    if value("p3") or value("p4"):
        what = f"{whose} has tangential distortion P3 and P4, which is not read"
        raise PlgsError("lens-model", what, path, "Align without P3 and P4, or export undistorted photos.")
    f, fx = value("f"), value("f") + value("b1")
    middle = width / 2.0 + value("cx"), height / 2.0 + value("cy")
    lens = pinhole(width, height, fx, f, *middle, path=path, fix=_FIX, whose=whose)
    radial = tuple(value(f"k{power}") for power in range(1, 5))
    tangential = value("p2"), value("p1")
    return lens, Distortion(radial, (), tangential, is_fisheye=kind == "fisheye", skew=value("b2") / fx)


def _on_the_ground(world: _World, centre: Array) -> _World:
    """The transform with ``centre``, a point on the Earth, moved to the origin, x to the east, y to the north, z up."""
    up = centre / max(float(np.linalg.norm(centre)), 1e-9)
    east = np.array([-up[1], up[0], 0.0]) if np.hypot(*up[:2]) > 1e-9 else np.array([1.0, 0.0, 0.0])
    east = east / np.linalg.norm(east)
    axes = np.stack([east, np.cross(up, east), up])
    return _World(axes @ world.rotation, axes @ (world.translation - centre), world.scale)


FORMAT = SceneFormat("metashape", lambda place: _file(place) is not None, _read)
