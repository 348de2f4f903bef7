"""One multilayer EXR per view: single part, ZIP, names as Blender's compositor reads them. The colour is stored twice:
as R, G, B and A, which every viewer shows, and as a layer among the others.

Ids, depth and Cryptomatte are 32-bit floats and exact. Colour, confidence, entropy and normals are half floats. Frame
and camera are described by OpenEXR's standard attributes (https://openexr.com/en/latest/StandardAttributes.html). Its
matrices are multiplied from the left by points in rows. Its camera looks along +z with x to the right and y up. (0, 0)
to (1, 1) in its NDC is the display window, from the upper left corner to the lower right one."""

from __future__ import annotations

import mmap
import os
import re
import struct
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..errors import PlgsError
from ..gates import create_plain, open_plain, refuse_special
from ..job import FURTHER_LAYERS, write_atomically
from ..job.system import main_memory
from ..machine.threads import worker_count
from ..posed.exr_header import ExrHeader, read_exr_header
from ..posed.frames import as_pose
from ..scene import Camera
from . import cryptomatte
from .baked_view import BakedView
from .layers import PanopticLayers

_SQUARE = 0.01
"""Largest deviation of a pixel's aspect from 1 that is written as square: a calibration is no more exact."""
_MOST_RATE = 60
"""Frames per second that a time code can count."""
_LARGEST_RATE = 1_000_000
"""Frames per second above which a rate is no camera's and is left out."""
_LIKE_NTSC = 1e-3
"""Largest deviation of a rate from a whole number / 1.001 that is rounding: 23.976 and 29.97 are written so."""
_RATE = "framesPerSecond"
_PLACE_OF_RATE = 10 * "."
"""A text as long as a rate with its longer type name: see `_put_rate`."""


@dataclass(frozen=True)
class ShownFrame:
    """The frame that a view shows: its ``number`` in its shot (None: the last one in its name), frames per second
    (``fps``; None: it has no time), and the ``display`` window in the picture: left, top, width and height in pixels
    (None: the whole picture)."""

    number: int | None = None
    fps: float | None = None
    display: tuple[int, int, int, int] | None = None


REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Red, green, blue and white of the colours, which are linear, in CIE x and y."""
NOTHING_SHOWN = ShownFrame()
_LINES = 16
"""Lines of the picture in a chunk of ZIP_COMPRESSION."""
_SOFTWARE = "PLGS "
"""Start of the header's attribute of this name in each file that is written."""
PROJECTION_NOTE = "plgs/projection"
"""Header attribute of a view that is not perspective: how its pixels look into the world."""
_OWN = {"type", "channels", "compression", "lineOrder", "dataWindow", "displayWindow", "pixelAspectRatio", "software"}
_OWN |= {"screenWindowWidth", "screenWindowCenter", "chromaticities", "colorInteropID", "worldToCamera", "worldToNDC"}
_OWN |= {"imageCounter", "timeCode", _RATE}
"""The header's attributes, beside Cryptomatte's and our own notes."""


def frame_header(camera: Camera, shown: ShownFrame, name: str) -> dict[str, Any]:
    """Return the header's attributes for the view ``name``, whose picture ``camera`` shows."""
    import OpenEXR

    left, top, width, height = shown.display or (0, 0, *camera.size)
    aspect = camera.fy / camera.fx
    header: dict[str, Any] = {
        "dataWindow": _box(-left, -top, *camera.size),
        "displayWindow": _box(0, 0, width, height),
        "pixelAspectRatio": 1.0 if abs(aspect - 1.0) < _SQUARE else aspect,
        "chromaticities": REC_709,
        "colorInteropID": "lin_rec709_scene",
        "software": _SOFTWARE + __version__,
        "worldToCamera": _in_rows(np.diag([1.0, -1.0, 1.0, 1.0]) @ camera.world_to_camera),
    }
    if camera.projection == "equirectangular":
        edges = np.degrees(np.array([-camera.cx, camera.width - camera.cx]) / camera.fx)
        ends = np.degrees(np.array([camera.cy - camera.height, camera.cy]) / camera.fy)
        spans = [" to ".join(f"{each:.6g}" for each in span) for span in (edges, ends)]
        header["plgs/depth"] = "metres along the ray, not planar"
        header[PROJECTION_NOTE] = f"equirectangular, longitude {spans[0]}, latitude {spans[1]} degrees"
    else:
        header["worldToNDC"] = _in_rows(_to_ndc(camera, left, top, width, height) @ camera.world_to_camera)
        # The picture on a plane at distance 1, y up.
        header["screenWindowWidth"] = width / camera.fx
        header["screenWindowCenter"] = np.array(
            [(left + width / 2 - camera.cx) / camera.fx, (camera.cy - top - height / 2) / camera.fy], np.float32
        )
    if camera.projection == "orthographic":
        header[PROJECTION_NOTE] = "orthographic"
    number = number_in(name) if shown.number is None else shown.number
    if number is not None:
        header["imageCounter"] = number
    rate = exact_rate(shown.fps or 0.0)
    if rate is not None:
        header[_RATE] = rate
    if number is not None and number >= 0 and rate is not None and 0 < round(rate) <= _MOST_RATE:
        seconds, frame = divmod(number, round(rate))
        clock = seconds // 3600 % 24, seconds // 60 % 60, seconds % 60, frame
        header["timeCode"] = OpenEXR.TimeCode(*clock, *(14 * (0,)))  # no flags or user data
    return header


def exact_rate(fps: float) -> Fraction | None:
    """Return the exact frame rate that a rounded one means (24000/1001 for 23.976); None if it is no camera's."""
    if not 0.0 < fps <= _LARGEST_RATE:
        return None
    ntsc = Fraction(1000 * round(fps), 1001)
    close = abs(fps - ntsc) < _LIKE_NTSC
    return (ntsc if close else Fraction(fps).limit_denominator(1000)) or None


def number_in(name: str) -> int | None:
    """Return a frame's number, the last one in its name, or None; -3 in "shot.-003"."""
    found = re.search(r"((?<=\.)-)?(\d{1,9})\D*$", name)
    return None if found is None else int((found[1] or "") + found[2])


def _box(left: int, top: int, width: int, height: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    return np.array([left, top], np.int32), np.array([left + width - 1, top + height - 1], np.int32)  # ends inclusive


def _to_ndc(camera: Camera, left: int, top: int, width: int, height: int) -> NDArray[np.float64]:
    """The transform from our camera space to NDC, float64 [4, 4]; z becomes 1 / depth, except in parallel views."""
    if camera.projection == "orthographic":
        scale, middle = (
            [camera.fx / width, camera.fy / height, 1.0],
            ((camera.cx - left) / width, (camera.cy - top) / height),
        )
        return as_pose(np.diag(scale), [*middle, 0.0])
    matrix = np.zeros((4, 4))
    matrix[0, [0, 2]] = camera.fx / width, (camera.cx - left) / width
    matrix[1, [1, 2]] = camera.fy / height, (camera.cy - top) / height
    matrix[2, 3] = matrix[3, 2] = 1.0
    return matrix


def _in_rows(matrix: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.ascontiguousarray(matrix.T, np.float32)


LAYER = "PLGS"
EXACT_IDS = 1 << 24
"""Ids below this are exact in 32-bit floats."""


def write_exr(
    path: Path,
    view: BakedView,
    *,
    notes: Mapping[str, str] | None = None,
    layers: Collection[str] = (),
    shown: ShownFrame = NOTHING_SHOWN,
    named_for: str = "blender",
) -> None:
    """Write a baked view, completely or not at all. The same input gives the same bytes. ``notes``: further attributes
    of the header; ``layers``: the wanted ones of FURTHER_LAYERS; ``shown``: the view's frame, for the header;
    ``named_for``: one of CHANNELS. Raises ValueError for ids that a 32-bit float cannot hold, and OSError."""
    largest = max(int(ids.max(initial=0)) for ids in (view.layers.semantic, view.layers.instance))
    if largest >= EXACT_IDS:
        raise ValueError(f"class and instance ids must be below {EXACT_IDS} to be exact in an EXR")
    channels = _pass_channels(view, layers)
    if named_for == "nuke":
        channels = {_in_nuke(name): plane for name, plane in channels.items() if "Combined" not in name}
        for name in {"forward.u", "forward.v"} & {*channels}:
            channels[name] = -channels[name]  # Nuke's vectors point to the next frame, Blender's come from it
    header = frame_header(view.camera, shown, path.stem) | dict(notes or {})
    for matte in view.mattes:
        channels |= cryptomatte.channels(matte.layer.name, matte.ranks)
        header |= cryptomatte.header(matte.layer.name, matte.layer.names)
    write_atomically(path, lambda part: _write(part, header, channels))


def read_exr(path: Path) -> PanopticLayers:
    """Read the PLGS layer of a baked view. Raises ValueError if the file is damaged or has no such layer, OSError."""
    # Reading allocates all that the header claims.
    memory, numbers = main_memory(), _header(path).numbers
    if memory is not None and 4 * numbers > memory.free:
        raise ValueError(f"{path} takes {4e-9 * numbers:.1f} GB, but {memory.free / 1e9:.1f} GB are free")
    names = [f"{LAYER}.Combined.{c}" for c in "RGBA"]
    names += [f"{LAYER}.{name}.V" for name in ("Depth", "Semantic", "Instance", "Confidence", "Entropy")]
    try:
        found = _channels(path)
        missing = [name for name in names if name not in found]
        if missing:
            raise ValueError(f"{path} has no channel {missing[0]}: it is not a pass of a lift")
        return _layers(found, names)
    except MemoryError as error:
        raise ValueError(f"{path} cannot be read: no memory is left for it") from error


def _layers(found: Mapping[str, NDArray[Any]], names: Sequence[str]) -> PanopticLayers:
    combined, (depth, semantic, instance, confidence, entropy) = names[:4], (found[name] for name in names[4:])
    return PanopticLayers(
        combined=np.stack([found[name] for name in combined], axis=-1).astype(np.float32),
        depth=depth,
        semantic=np.rint(semantic).astype(np.int32),
        instance=np.rint(instance).astype(np.int32),
        confidence=confidence.astype(np.float32),
        entropy=entropy.astype(np.float32),
    )


_NUKE = {"depth.V": "depth.Z", "vector.X": "backward.u", "vector.Y": "backward.v"}
_NUKE |= {"vector.Z": "forward.u", "vector.W": "forward.v"}


def _in_nuke(name: str) -> str:
    """Return a channel's name for Nuke: Nuke's own name for depth and motion, else our ``name`` in lower case."""
    _, dot, ours = name.partition(f"{LAYER}.")
    layer, _, axis = ours.partition(".")
    return _NUKE.get(f"{layer.lower()}.{axis}", f"{layer.lower()}.{axis}") if dot else name


def further_layers(path: Path) -> set[str]:
    """Return the FURTHER_LAYERS that a baked view has. Raises PlgsError if it is damaged."""
    channels, first = read_exr_header(path).channels, {each: f"{LAYER}.{each.title()}.X" for each in FURTHER_LAYERS}
    return {layer for layer, name in first.items() if name in channels or _in_nuke(name) in channels}


def read_note(path: Path, name: str) -> str | None:
    """Return an attribute of a baked view's header; None if it has none. Raises ValueError for damage, OSError."""
    kind, value = _header(path).attributes.get(name.encode(), (b"", b""))
    return value.decode() if kind == b"string" else None


def is_frame(path: Path, shown: ShownFrame) -> bool:
    """Whether a baked view's header has this frame's number and rate. Raises ValueError if it is damaged, OSError."""
    attributes = _header(path).attributes
    number = number_in(path.stem) if shown.number is None else shown.number
    rate = exact_rate(shown.fps or 0.0)
    wanted = {
        b"imageCounter": None if number is None else (b"int", struct.pack("<i", number)),
        _RATE.encode(): None if rate is None else (b"rational", struct.pack("<iI", rate.numerator, rate.denominator)),
    }
    return all(attributes.get(name) == value for name, value in wanted.items())


def is_own(path: Path) -> bool:
    """Whether a file's header says that PLGS wrote it, and no other program afterwards: programs that keep all
    attributes add their own, such as capDate, or leave out the type. Raises OSError."""
    try:
        names = {name.decode("utf-8", "replace") for name in _header(path).attributes}
        others = {name for name in names - _OWN if not name.startswith(("plgs/", "cryptomatte/"))}
        return not others and "type" in names and (read_note(path, "software") or "").startswith(_SOFTWARE)
    except ValueError:
        return False


def is_cut(path: Path) -> bool:
    """Whether an EXR that PLGS wrote ends before its pixels do, as after a copy that was interrupted. Raises ValueError
    if its header is damaged, OSError."""
    header = _header(path)
    chunks = -(-header.size[1] // _LINES)
    with open_plain(path) as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(9 + sum(6 + len(name + kind + value) for name, (kind, value) in header.attributes.items()))
        places = np.frombuffer(file.read(8 * chunks), "<u8")
        last = int(places.max(initial=0))
        if len(places) < chunks or not places.all() or last >= size:
            return True
        file.seek(last + 4)
        return file.tell() + 4 + int.from_bytes(file.read(4), "little") > size


def _header(path: Path) -> ExrHeader:
    """Read the header of a file. Raises ValueError if it is damaged, and OSError."""
    refuse_special(path)
    try:
        return read_exr_header(path)
    except PlgsError as error:
        raise ValueError(f"{path} is damaged ({error.what})") from error


def _channels(path: Path) -> dict[str, NDArray[Any]]:
    """Read the channels of a file, [H, W] each, by name. Raises ValueError if it is damaged."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: channel.pixels for name, channel in file.channels().items()}
    except MemoryError:  # says nothing about the file
        raise
    except Exception as error:  # the library raises errors of several kinds
        raise ValueError(f"{path} is damaged ({error})") from error


def _pass_channels(view: BakedView, further: Collection[str]) -> dict[str, NDArray[np.floating]]:
    layers = view.layers
    half = {f"Combined.{c}": layers.combined[..., k] for k, c in enumerate("RGBA")}
    half |= {"Confidence.V": layers.confidence, "Entropy.V": layers.entropy}
    exact = {"Depth.V": layers.depth, "Semantic.V": layers.semantic, "Instance.V": layers.instance}
    if view.guessed is not None:
        half["Guessed.V"] = np.clip(view.guessed, 0.0, 1.0)
    surface = view.surface if {*further} & {"normal", "position"} else None
    if surface is not None and "normal" in further:
        half |= {f"Normal.{c}": surface.normal[k] for k, c in enumerate("XYZ")}
    if surface is not None and "position" in further:
        exact |= {f"Position.{c}": surface.position[k] for k, c in enumerate("XYZ")}
    if "vector" in further:
        exact |= {f"Vector.{c}": plane for c, plane in zip("XYZW", view.vectors, strict=True)}
    channels = {f"{LAYER}.{name}": np.ascontiguousarray(values, np.float16) for name, values in half.items()}
    channels |= {c: channels[f"{LAYER}.Combined.{c}"] for c in "RGBA"}
    return channels | {f"{LAYER}.{name}": np.ascontiguousarray(values, np.float32) for name, values in exact.items()}


def _write(path: Path, attributes: Mapping[str, Any], channels: dict[str, NDArray[np.floating]]) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    rate = header.get(_RATE)
    if rate is not None:
        header[_RATE] = _PLACE_OF_RATE
    create_plain(path).close()  # what the system refuses is an OSError here, and a RuntimeError in the library
    OpenEXR.set_global_thread_count(worker_count())  # the library starts with none
    with OpenEXR.File(header, channels, worker_count()) as file:
        file.write(str(path))
    if rate is not None:
        _put_rate(path, rate)


def _put_rate(path: Path, rate: Fraction) -> None:
    """Replace the placeholder text for the frame rate in a file by the rate.

    The library reads attributes of type rational, but cannot write them. An attribute is stored as its name, its type,
    the length of its value, and the value. "rational" is two bytes longer than "string", so a text of ten bytes takes
    as much as a rate of eight, and nothing in the file moves. No text before it has zeros, so it is the first match."""
    name, text = _RATE.encode() + b"\0", _PLACE_OF_RATE.encode()
    placed = name + b"string\0" + struct.pack("<i", len(text)) + text
    exact = name + b"rational\0" + struct.pack("<iiI", 8, rate.numerator, rate.denominator)
    with open(path, "r+b") as file:
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            start = content.find(placed)
        file.seek(start)
        file.write(exact)
