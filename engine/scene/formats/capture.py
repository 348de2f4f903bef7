"""What readers of scene formats return: posed pictures in one convention, without masks or split."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.frames import Camera
from ...posed.layout import composed, listed, natural_order, shown_files
from ...posed.plain_folders import Split
from ...scene_source import UpAxis
from ..depth import DepthMap, fault_of
from ..frame import Inferred, LeftOut, SparsePoints, left_out
from ..view import Progress as Progress
from ..view import watched as watched
from .lens import STRAIGHT, Distortion

_NOT_IN_NAMES = re.compile(r'[\x00-\x1f<>:"|?*]')


@dataclass(frozen=True, eq=False)
class Shot:
    """One posed picture. ``camera`` has its pose in the format's own world, with OpenCV's axes, in metres.
    ``read_colour`` returns uint8 [H, W, 3] RGB at the camera's size; it is None if ``colour_path`` is that image.
    Readers remove the ``distortion`` from colour and depth. ``kept_pixels``: a picture, black where none counts."""

    name: str
    camera: Camera
    colour_path: Path
    depth: DepthMap | None = None
    read_colour: Callable[[], NDArray[np.uint8]] | None = None
    distortion: Distortion = STRAIGHT
    kept_pixels: Path | None = None


Found = Shot | PlgsError | None  # a picture as a reader found it: None without a pose, an error if it cannot be read


@dataclass(frozen=True, eq=False)
class Capture:
    """All pictures of a scene in recording order: ``found`` pairs each name with its Shot, with the error that makes it
    unreadable, or with None if it has no pose. ``up`` is the axis that points up, None if the format does not say; if
    it was measured (``up_is_known``), sideways cameras cause no warning. ``split`` is set by readers whose format has
    one. ``left_out`` lists frames besides those of ``found``, ``inferred`` what no file says. ``fps`` is the frame rate
    by which the numbers in names count, None if unknown. ``has_unit``: lengths are metres."""

    found: Sequence[tuple[str, Found]]
    up: UpAxis | None
    warnings: tuple[str, ...] = ()
    points: SparsePoints | None = None
    split: Split | None = None
    up_is_known: bool = False
    left_out: tuple[LeftOut, ...] = ()
    inferred: tuple[Inferred, ...] = ()
    fps: float | None = None
    has_unit: bool = True

    @property
    def shots(self) -> list[Shot]:
        return [shot for _, shot in self.found if isinstance(shot, Shot)]

    @property
    def unreadable(self) -> dict[str, PlgsError]:
        """The errors of unreadable pictures, by name. Their frames are left out."""
        return {name: shot for name, shot in self.found if isinstance(shot, PlgsError)}

    @property
    def lost(self) -> list[str]:
        """The names of pictures without a pose. Their frames are left out."""
        return [name for name, shot in self.found if shot is None]


def with_picture(picture: Path, make: Callable[[], Shot | None] | None) -> Found:
    """Return ``make()``, or the error if ``picture``'s header is bad; None without ``make``, for lack of a pose."""
    return None if make is None else fault_of(picture) or make()


ListedCamera = tuple[str, Path | None, Callable[[Path], Shot | None] | None]
"""A camera in another program's table: its frame's name, its picture (None: missing), and what makes a shot of that
(None: it has no pose)."""


def shots_of(
    cameras: Sequence[ListedCamera], place: Path, progress: Progress
) -> tuple[list[tuple[str, Found]], tuple[LeftOut, ...]]:
    """Return what was found for each of ``cameras``, by name in natural order, and which frames were left out. Raises
    PlgsError if all pictures are missing at ``place``."""
    missing = [name for name, picture, _ in cameras if picture is None]
    if missing and len(missing) == len(cameras):
        raise PlgsError("no-pictures", f"the pictures are missing ({listed(missing)})", place, "Copy them there.")
    found: list[tuple[str, Found]] = [
        (name, with_picture(picture, None if make is None else partial(make, picture)))
        for name, picture, make in watched(sorted(cameras, key=lambda each: natural_order(each[0])), progress)
        if picture is not None
    ]
    return found, left_out("a picture", missing)


def only_file(place: Path, suffix: str) -> Path | None:
    """Return the file with this suffix: ``place`` itself, or the only such file in that folder; else None."""
    if place.is_file():
        return place if place.suffix.lower() == suffix else None
    found = [path for path in shown_files(place, f"*{suffix}") if path.is_file()]
    return found[0] if len(found) == 1 else None


@dataclass(frozen=True)
class SceneFormat:
    """A format of scenes by its ``name``, one of `SCENE_FORMAT_NAMES`. ``recognises`` says whether a folder or file has
    it, by names alone. ``read`` opens the frames and reads only the headers of pictures. It raises PlgsError."""

    name: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, Progress], Capture]


def frame_names(paths: Sequence[str]) -> list[str]:
    """The names of frames: the stems of ``paths`` if these are all different, else the whole paths with ``_`` between
    their parts. Other files are named after frames, so characters not allowed in file names become ``_`` too."""
    pure = [PurePosixPath(path.replace("\\", "/")) for path in paths]  # files written on Windows
    parts = [(each.with_suffix("") if each.name else each).parts for each in pure]  # with_suffix needs a name
    named = [[part for part in each if part not in (".", "..", "/", "//")] for each in parts]  # perhaps nothing
    stems = [each[-1] if each else "" for each in named]
    if len(set(stems)) < len(stems):
        stems = ["_".join(each) for each in named]
    return [_NOT_IN_NAMES.sub("_", composed(stem)) or "_" for stem in stems]
