"""Opening a scene: a format's reader gives posed pictures, to which masks, ground truth and the split are added.

Formats: see ``formats/``. Masks: see ``masks.py``. Ground truth: see ``ground_truth.py``. ``splits.json`` in the folder
is honoured in every format; a scene that is one file has these things in a folder of the same name beside it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .estimated_depth import with_estimated_depth
from .formats import Capture, Shot, find_format
from .frame import Frame, Scene, SceneError, Size
from .ground_truth import GroundTruthSet, open_ground_truth
from .layout import listed, same_shape, shown_size
from .mask_set import MaskSet
from .masks import find_masks
from .matrices import UpAxis, placed, to_z_up, turned, up_axis_warning
from .splits import find_split
from .upright import upright_rotation

_FAR_ASIDE = 0.2
_ASIDE = "the principal point is far from the middle (are the intrinsics in pixels of the colour images?)"
_READABLE = "Check that it exists, and its permissions."
_UNKNOWN_UP = "the format does not say which way is up: the world is turned so that the cameras stand upright"


class AskedScene(Protocol):
    """Who knows which scene is meant and how it is read, as ``open_scene`` has it: a lift's request, a SceneSource."""

    @property
    def scene(self) -> Path: ...
    @property
    def masks(self) -> Path | None: ...
    @property
    def up(self) -> UpAxis: ...
    @property
    def scene_format(self) -> str | None: ...
    @property
    def depth(self) -> Path | None: ...
    @property
    def mask_format(self) -> str | None: ...
    @property
    def classes(self) -> str | None: ...


def open_asked(asked: AskedScene) -> Scene:
    """``open_scene`` of the scene that is asked for."""
    return open_scene(
        asked.scene, asked.masks, asked.up, asked.scene_format, asked.depth, asked.mask_format, asked.classes
    )


def open_scene(
    folder: Path,
    masks: Path | None = None,
    up: UpAxis = "z",
    scene_format: str | None = None,
    depth: Path | None = None,
    mask_format: str | None = None,
    classes: str | None = None,
) -> Scene:
    """Open a scene without decoding an image.

    ``folder`` may be a file in formats that are one. ``masks`` names the panoptic masks when they are not in the
    folder. ``up`` is the axis of its poses' world that points up; "z" leaves it to formats that say it themselves.
    ``scene_format`` names the format when its looks do not tell. ``depth`` is a folder of monocular depth maps, which
    take the place of the scene's depth, see ``estimated_depth``. ``mask_format`` names the masks' format when its looks
    do not tell; ``classes`` a table of their classes or a file, see ``find_class_choice``. Masks and depth may be
    missing, see ``require_liftable``.

    Raises SceneError for the first thing that is wrong; ``check_scene`` looks into the pixels as well.
    """
    place, masks = Path(folder), None if masks is None else Path(masks)
    reader = find_format(place, scene_format)
    try:
        capture = reader.read(place)
    except OSError as error:
        raise SceneError(f"this cannot be read ({error.strerror})", error.filename or place, _READABLE) from error
    _refuse_repeated_names(capture.shots, place)
    beside = place if place.is_dir() else place.with_suffix("")
    split = capture.split or find_split(beside, [shot.name for shot in capture.shots], capture.lost)
    chosen, held_out = {*split.train, *split.test}, frozenset(split.test)
    shots = [shot for shot in capture.shots if shot.name in chosen]
    turn, turn_warnings = _turn_upright(capture, up)
    cameras = {shot.name: placed(shot.camera, turned(shot.camera.camera_to_world, turn)) for shot in shots}
    sizes = {shot.name: (shot.camera.width, shot.camera.height) for shot in shots}
    mask_set = find_masks(beside, masks, list(sizes), mask_format, classes)
    _check_mask_shapes(mask_set, sizes)
    truth = open_ground_truth(beside, sizes, mask_set.classes) if mask_set.readers else GroundTruthSet({})
    lost = f"{len(capture.lost)} frames without a pose are left out: {listed(capture.lost)}"
    points = None if capture.points is None else capture.points.turned(turn)
    frames = tuple(
        Frame(
            name=shot.name,
            camera=cameras[shot.name],
            held_out=shot.name in held_out,
            colour_path=shot.colour_path,
            depth_path=shot.depth_path,
            read_colour=shot.read_colour,
            read_depth=shot.read_depth,
            read_mask=mask_set.readers.get(shot.name),
            read_ground_truth=truth.readers.get(shot.name),
            file_shows_colour=shot.file_shows_colour,
        )
        for shot in shots
    )
    depth_warnings: list[str] = []
    if depth is not None:
        frames, depth_warnings = with_estimated_depth(frames, Path(depth), points)
    return Scene(
        folder=place,
        frames=frames,
        classes=mask_set.classes,
        warnings=(
            *([lost] if capture.lost else []),
            *split.warnings,
            *turn_warnings,
            *_lens_warnings(cameras),
            *capture.warnings,
            *depth_warnings,
            *mask_set.warnings,
            *truth.warnings,
        ),
        format=reader.name,
        points=points,
        turn=None if np.array_equal(turn, np.eye(3)) else turn,
    )


def _refuse_repeated_names(shots: Sequence[Shot], place: Path) -> None:
    if not shots:
        raise SceneError("there is no picture with a pose", place, "Give frames whose pose is known.")
    twice = [name for name, count in Counter(shot.name for shot in shots).items() if count > 1]
    if twice:
        raise SceneError(f"frames share a name ({listed(twice)})", place, "Give each picture a name of its own.")


def _turn_upright(capture: Capture, up: UpAxis) -> tuple[NDArray[np.float64], list[str]]:
    """The rotation, float64 [3, 3], from the capture's world into one with z up, and warnings."""
    poses = [shot.camera.camera_to_world for shot in capture.shots]
    axis = capture.up if up == "z" else up
    if axis is None:
        turn = upright_rotation(poses)
        return turn, [] if np.array_equal(turn, np.eye(3)) else [_UNKNOWN_UP]
    turn = to_z_up(axis)
    if capture.up_is_known and axis == capture.up:
        return turn, []
    tilted = up_axis_warning([turned(pose, turn) for pose in poses], axis)
    return turn, [tilted] if tilted else []


def _check_mask_shapes(masks: MaskSet, sizes: Mapping[str, Size]) -> None:
    for name in masks.readers:
        if not same_shape(masks.sizes[name], sizes[name]):
            raise SceneError(
                f"a mask of {shown_size(masks.sizes[name])} does not fit the colour of {shown_size(sizes[name])}",
                masks.paths[name],
                "Bring masks to the colour images' aspect ratio.",
            )


def _lens_warnings(cameras: Mapping[str, Camera]) -> Iterable[str]:
    aside = [name for name, lens in cameras.items() if _is_far_aside(lens)]
    if aside:
        yield f"{_ASIDE}: {listed(aside)}"


def _is_far_aside(lens: Camera) -> bool:
    return abs(lens.cx / lens.width - 0.5) > _FAR_ASIDE or abs(lens.cy / lens.height - 0.5) > _FAR_ASIDE
