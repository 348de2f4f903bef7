"""Read notes of our own commands that say what of a scene was not measured: depth that a network made (``made_depth``),
poses and their unit, and the licences of networks. All of it is shown wherever warnings are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PlgsError
from ..job import write_atomically
from ..job.own_files import OwnFiles
from ..json_file import read_object, to_text
from ..posed.frames import Camera
from ..posed.plain_folders import NAME
from ..records import record_of
from .depth import DepthMap, npy_depth
from .frame import Inferred, Scene

DEPTH_FOLDER = "made_depth"
"""The folder in a scene's folder where ``engine depth`` writes a .npy a frame, in the unit of the poses."""
MADE_BY = "made_by.json"
SCALE = "scale.json"
"""The file in a scene's folder that says by what its lengths are multiplied: ``{"scale": 1.5}``."""
_AGAIN = "Delete it, then give the same command again."
_ALIKE = 1e-3  # relative difference of focal lengths and of the cameras' distances from their middle
_SCALES = (1e-4, 1e4)


@dataclass(frozen=True)
class MadeDepth:
    """The note ``made_by.json`` about depth that a network made: the network's name (``model``), ``licence`` and
    whether that allows ``commercial_use``, the number of ``frames``, and by name the digests of their ``photos`` and
    their `layout_of`."""

    model: str = field(metadata={"longest": 5000})
    frames: int
    photos: Mapping[str, str]
    layout: Mapping[str, tuple[float, float]]
    licence: str = field(default="", metadata={"shown": True})
    commercial_use: bool | None = None

    @classmethod
    def read(cls, beside: Path) -> MadeDepth | None:
        """Read the note in the folder ``beside``; None if there is no note. Raises PlgsError if it is damaged."""
        path = beside / DEPTH_FOLDER / MADE_BY
        content = read_note(path, _AGAIN)
        return None if content is None else record_of(cls, content, path, _AGAIN)


@dataclass(frozen=True)
class _Scale:
    scale: float = field(metadata={"least": _SCALES[0], "most": _SCALES[1]})


def read_note(path: Path, fix: str) -> dict[str, Any] | None:
    """Return the JSON object in a note of PLGS, or None if nothing has this name. Raises PlgsError, with ``fix`` as the
    advice, if it is damaged, and for a folder, a FIFO, or a broken link, which must not count as a missing note."""
    try:
        return read_object(path, fix)
    except PlgsError as error:
        if isinstance(error.__cause__, FileNotFoundError | NotADirectoryError) and not path.is_symlink():
            return None
        raise


def layout_of(cameras: Mapping[str, Camera], scale: float = 1.0) -> dict[str, list[float]]:
    """Return two facts about each frame's camera on which depth from a network depends: the focal length divided by the
    picture's width, and the distance from the mean of all cameras, divided by ``scale``. Rotations change neither."""
    if not cameras:
        return {}
    middle = np.mean([camera.centre for camera in cameras.values()], axis=0)
    return {
        name: [camera.fx / camera.width, float(np.linalg.norm(camera.centre - middle)) / scale]
        for name, camera in cameras.items()
    }


def made_depth(beside: Path, cameras: Mapping[str, Camera]) -> dict[str, DepthMap]:
    """Return the depth that ``engine depth`` made for these frames, by name; none if there is none. Raises PlgsError if
    it was made for other poses."""
    folder, made = beside / DEPTH_FOLDER, MadeDepth.read(beside)
    if made is None:
        return {}
    known, now = made.layout, layout_of(cameras).items()
    if not all(name in known and np.allclose(known[name], at, rtol=_ALIKE, atol=_ALIKE) for name, at in now):
        what, fix = "the poses have changed since depth was made for them", "Move this folder away, then make it again."
        raise PlgsError("other-poses", what, folder, fix)
    files = {name: folder / f"{name}.npy" for name in cameras}
    return {name: npy_depth(path) for name, path in files.items() if path.is_file()}


def scale_of(beside: Path) -> float:
    """The factor that multiplies a scene's lengths, from the file of `engine scale` in ``beside``; 1 without that file.
    Raises PlgsError if that is damaged."""
    content = read_note(beside / SCALE, _AGAIN)
    return 1.0 if content is None else record_of(_Scale, content, beside / SCALE, _AGAIN).scale


def set_scale(scene: Scene, beside: Path, factor: float | None, measured: Sequence[float] | None) -> float:
    """Write the factor that multiplies a scene's lengths into the folder ``beside`` it, and return it. It is
    ``factor``, or follows from ``measured``: a length in the scene as it is now, and the true length in metres. Raises
    PlgsError for a factor beyond all use, OSError."""
    if scene.format == NAME:
        raise PlgsError("has-unit", "scenes of this format are in metres", scene.folder, "Correct the lengths there.")
    if measured is not None and measured[0] > 0.0:
        factor = scale_of(beside) * measured[1] / measured[0]
    if factor is None or not _SCALES[0] <= factor <= _SCALES[1]:
        what = "the scale must be from 0.0001 to 10000"
        raise PlgsError("bad-scale", what, beside, "Give positive lengths, the second in metres.")
    beside.mkdir(exist_ok=True)
    with OwnFiles(beside).begin("scale", {}, among_others=True) as own:
        own.set_aside(beside / SCALE)
        write_atomically(beside / SCALE, to_text({"scale": factor}))
    own.complete()
    return factor


def estimates(beside: Path, masks: Path, *, has_made_depth: bool, has_unit: bool) -> Iterator[Inferred]:
    """Yield what in a scene was estimated and not measured: depth, lengths and masks, by the notes in the folders.
    ``has_made_depth`` says whether a network's depth is used, ``has_unit`` whether the format gives metres."""
    if has_made_depth and (made := MadeDepth.read(beside)) is not None:
        taken = f"estimated: depth is made of the photos by {made.model}"
        yield Inferred("depth", taken, "it is fitted to the reconstruction's points; what disagrees has none")
        yield from _licence(made.licence, made.commercial_use)
    if scale_of(beside) != 1.0:
        said = f"lengths are multiplied by {scale_of(beside):.6g}"
        yield Inferred("units", said, f"{SCALE} says so", is_doubtful=False)
    elif not has_unit:
        said = "estimated: lengths are by the reconstruction's scale, which is unknown"
        yield Inferred("units", said, "measure one distance, and give it to engine scale or Set Scale")
    for path in (masks / "panoptic" / MADE_BY, masks / MADE_BY):
        if (record := read_note(path, _AGAIN)) is not None:
            yield from _licence(record.get("licence"), record.get("commercial_use"))
            break


def _licence(licence: object, is_commercial: object) -> Iterator[Inferred]:
    if isinstance(licence, str) and licence:
        yield Inferred("licence", f"licence: {licence[:300]}", "its authors state it there", is_commercial is False)
