"""Opening a scene: the folders ``color/ depth/ pose/ intrinsic/`` as ScanNet exports and Panoptic Lifting use them.

* ``color/<name>.jpg`` or ``.png``; the names are the frames, in natural order.
* ``depth/<name>.png``, 16 bits, millimetres along the optical axis, 0 = none; of any size with the colour's shape.
* ``pose/<name>.txt``, camera-to-world, 4x4, OpenCV axes, metres. A pose with inf (lost tracking) drops the frame.
* ``intrinsic/intrinsic_color.txt``, 3x3 or 4x4, in pixels of the colour images with integer pixel centres. It belongs
  to the size that most colour images have (at a tie, to the first's) and is scaled for frames of another size and the
  same shape. ``intrinsic/<name>.txt`` overrides it for one frame, at that frame's own size.
* ``intrinsic/intrinsic_depth.txt``, optional, in pixels of the depth images: where its lens differs from the colour's,
  depth is read through it (same centre, other lens, as ScanNet's sensor has). Without it the two pictures coincide.
* ``splits.json``, optional: ``{"train": [...], "test": [...]}``.

Masks: see ``masks.py``. Ground truth: see ``ground_truth.py``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .depth import open_depth
from .frame import Frame, Scene, SceneError, Size
from .ground_truth import open_ground_truth
from .image_header import read_image_header
from .layout import files_by_stem, listed, require_all, same_shape, shown_size
from .masks import MaskSet, open_masks
from .matrices import UpAxis, placed, read_intrinsics, read_pose, up_axis_warning
from .pixels import decode, resize_colour
from .splits import default_split, read_split

_FAR_ASIDE = 0.2
_ASIDE = "the principal point is far from the middle (are the intrinsics in pixels of the colour images?)"
_FOLDERS_FIX = "A scene has the folders color, depth, pose and intrinsic."


@dataclass(frozen=True)
class ColourReader:
    """Reads one frame's colour image."""

    path: Path

    def __call__(self, size: Size | None = None) -> NDArray[np.uint8]:
        """uint8 [H, W, 3] RGB at ``size`` (width, height) or the image's own. Raises SceneError."""
        pixels = decode(self.path, as_colour=True)
        return resize_colour(pixels, size) if size else pixels


def open_scene(folder: Path, masks: Path | None = None, up: UpAxis = "z") -> Scene:
    """Open a scene's folder without decoding an image. ``up`` is the axis of its poses' world that points up.

    ``masks`` names the panoptic masks when they are not in the folder. Raises SceneError for the first thing that is
    wrong; ``check_scene`` looks into the pixels as well.
    """
    folder, masks = Path(folder), None if masks is None else Path(masks)
    colours, poses, held_out, warnings = _find_frames(folder, up)
    sizes = {name: read_image_header(path).size for name, path in colours.items()}
    lenses = _read_lenses(folder / "intrinsic", sizes)
    depths = open_depth(folder, lenses)
    mask_set = open_masks(folder, masks, list(colours))
    _check_mask_shapes(mask_set, sizes)
    truth = open_ground_truth(folder, sizes, mask_set.classes)
    return Scene(
        folder=folder,
        frames=tuple(
            Frame(
                name=name,
                camera=placed(lenses[name], poses[name]),
                held_out=name in held_out,
                colour_path=path,
                depth_path=depths.readers[name].path,
                read_colour=ColourReader(path),
                read_depth=depths.readers[name],
                read_mask=mask_set.readers[name],
                read_ground_truth=truth.readers.get(name),
            )
            for name, path in colours.items()
        ),
        classes=mask_set.classes,
        warnings=(
            *warnings,
            *_camera_warnings(lenses, [poses[name] for name in colours], up),
            *depths.warnings,
            *mask_set.warnings,
            *truth.warnings,
        ),
    )


def _find_frames(
    folder: Path, up: UpAxis
) -> tuple[dict[str, Path], dict[str, NDArray[np.float64]], frozenset[str], list[str]]:
    """The frames in use: colour images by name, poses by name, which names are held out; and warnings."""
    if not folder.is_dir():
        raise SceneError("there is no such folder", folder, "Name the folder of a scene.")
    colours = files_by_stem(folder / "color", {".jpg", ".jpeg", ".png"}, _FOLDERS_FIX)
    poses, dropped = _read_poses(folder / "pose", list(colours), up)
    if not poses:
        raise SceneError("every pose holds inf (lost tracking)", folder / "pose", "Give frames whose pose is known.")
    table = folder / "splits.json"
    split = read_split(table, list(poses), dropped) if table.is_file() else default_split(list(poses))
    if not split.train:
        raise SceneError("there is no frame to train on", table, "Name frames in train.")
    chosen = {*split.train, *split.test}
    lost = f"{len(dropped)} frames without a pose (inf) are left out: {listed(dropped)}"
    return (
        {name: path for name, path in colours.items() if name in chosen},
        poses,
        frozenset(split.test),
        [*([lost] if dropped else []), *split.warnings],
    )


def _check_mask_shapes(masks: MaskSet, sizes: Mapping[str, Size]) -> None:
    for name, size in sizes.items():
        if not same_shape(masks.sizes[name], size):
            raise SceneError(
                f"a mask of {shown_size(masks.sizes[name])} does not fit the colour of {shown_size(size)}",
                masks.paths[name],
                "Bring masks to the colour images' aspect ratio.",
            )


def _camera_warnings(lenses: Mapping[str, Camera], poses: Sequence[NDArray[np.float64]], up: UpAxis) -> Iterable[str]:
    tilted = up_axis_warning(poses, up)
    if tilted:
        yield tilted
    aside = [name for name, lens in lenses.items() if _is_far_aside(lens)]
    if aside:
        yield f"{_ASIDE}: {listed(aside)}"


def _is_far_aside(lens: Camera) -> bool:
    return abs(lens.cx / lens.width - 0.5) > _FAR_ASIDE or abs(lens.cy / lens.height - 0.5) > _FAR_ASIDE


def _read_poses(folder: Path, names: Sequence[str], up: UpAxis) -> tuple[dict[str, NDArray[np.float64]], list[str]]:
    """Poses, float64 [4, 4], by name, and the names of frames whose tracking was lost."""
    files = files_by_stem(folder, {".txt"}, _FOLDERS_FIX)
    require_all(names, files, "pose", folder, "Add pose/<name>.txt, or take their colour images away.")
    poses: dict[str, NDArray[np.float64]] = {}
    dropped: list[str] = []
    for name in names:
        pose = read_pose(files[name], up)
        if pose is None:
            dropped.append(name)
        else:
            poses[name] = pose
    return poses, dropped


def _read_lenses(folder: Path, sizes: Mapping[str, Size]) -> dict[str, Camera]:
    """Each frame's intrinsics at its colour image's size, as a camera at the origin."""
    if not folder.is_dir():
        raise SceneError("a folder is missing", folder, _FOLDERS_FIX)
    shared_path = folder / "intrinsic_color.txt"
    base = Counter(sizes.values()).most_common(1)[0][0]
    shared = read_intrinsics(shared_path, base) if shared_path.is_file() else None
    lenses: dict[str, Camera] = {}
    for name, size in sizes.items():
        own_path = folder / f"{name}.txt"
        if own_path.is_file():
            lenses[name] = read_intrinsics(own_path, size)
        elif shared is None:
            raise SceneError("the intrinsics are missing", shared_path, "Write the colour camera's 4x4 matrix there.")
        elif not same_shape(size, base):
            raise SceneError(
                f"frame {name} is {shown_size(size)}, which is not the shape of {shown_size(base)}",
                shared_path,
                f"Give the frame intrinsics of its own, intrinsic/{name}.txt.",
            )
        else:
            lenses[name] = shared.resized(*size)
    return lenses
