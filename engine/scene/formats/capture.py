"""Formats of scenes and the results of their readers: posed pictures in one convention, without masks and split."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ...errors import PlgsError
from ...posed.frames import Camera
from ...posed.layout import composed
from ...posed.plain_folders import Split
from ...scene_source import UpAxis
from ..depth import DepthMap, fault_of
from ..frame import Inferred, LeftOut, SparsePoints
from .lens import STRAIGHT, Distortion

_NOT_IN_NAMES = re.compile(r'[\x00-\x1f<>:"|?*]')


@dataclass(frozen=True, eq=False)
class Shot:
    """One posed picture. The camera stands in the format's own world, and its pose has OpenCV's axes and metres.

    ``read_colour`` gives uint8 [H, W, 3] RGB of the camera's size. It is None when the image file at ``colour_path``
    is the picture. ``distortion`` bends both pictures as they are read; the engine straightens them.
    ``kept_pixels`` is a picture that is black where pixels do not count.
    """

    name: str
    camera: Camera
    colour_path: Path
    depth: DepthMap | None = None
    read_colour: Callable[[], NDArray[np.uint8]] | None = None
    distortion: Distortion = STRAIGHT
    kept_pixels: Path | None = None


@dataclass(frozen=True, eq=False)
class Capture:
    """All pictures in recording order: ``found`` holds their names with a Shot each, None without a pose, or why the
    picture cannot be read (``with_picture``).

    ``up`` is the axis of the format's world that points up, None if the format does not say. ``up_is_known`` means
    that it was measured, so that cameras held sideways are no reason for a warning. ``split`` is given by readers that
    need it themselves. ``left_out`` are frames besides those of ``found``, ``inferred`` is what no file says.
    """

    found: Sequence[tuple[str, Shot | PlgsError | None]]
    up: UpAxis | None
    warnings: tuple[str, ...] = ()
    points: SparsePoints | None = None
    split: Split | None = None
    up_is_known: bool = False
    left_out: tuple[LeftOut, ...] = ()
    inferred: tuple[Inferred, ...] = ()

    @property
    def shots(self) -> list[Shot]:
        return [shot for _, shot in self.found if isinstance(shot, Shot)]

    @property
    def unreadable(self) -> dict[str, PlgsError]:
        """Why pictures cannot be read, by their names. They are left out."""
        return {name: shot for name, shot in self.found if isinstance(shot, PlgsError)}

    @property
    def lost(self) -> list[str]:
        """The names of pictures without a pose. They are left out."""
        return [name for name, shot in self.found if shot is None]


def with_picture(picture: Path, make: Callable[[], Shot | None]) -> Shot | PlgsError | None:
    """What ``make`` gives for the file ``picture``, or why this cannot be read, as far as its header says."""
    return fault_of(picture) or make()


@dataclass(frozen=True)
class SceneFormat:
    """A format of scenes by its ``name``, one of `SCENE_FORMAT_NAMES`. ``recognises`` says whether a folder or file has
    it; nothing is decoded for that. ``read`` raises PlgsError."""

    name: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path], Capture]


def frame_names(paths: Sequence[str]) -> list[str]:
    """The stems of ``paths`` if these are all different, else the whole paths with ``_`` between their parts. Other
    files are named after frames, so each character that no file name can hold becomes ``_`` too."""
    pure = [PurePosixPath(path.replace("\\", "/")) for path in paths]
    parts = [(each.with_suffix("") if each.name else each).parts for each in pure]
    named = [[part for part in each if part not in (".", "..", "/", "//")] for each in parts]  # perhaps nothing
    stems = [each[-1] if each else "" for each in named]
    if len(set(stems)) < len(stems):
        stems = ["_".join(each) for each in named]
    return [_NOT_IN_NAMES.sub("_", composed(stem)) or "_" for stem in stems]
