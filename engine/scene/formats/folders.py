"""The folders ``color/ depth/ pose/ intrinsic/`` as ScanNet exports and Panoptic Lifting's prepared scenes have them.

* ``color/<name>.jpg`` or ``.png``; the names are the frames, in natural order.
* ``depth/<name>.png``, 16 bits, millimetres along the optical axis, 0 = none; of any size with the colour's shape. The
  folder may be missing.
* ``pose/<name>.txt``, camera-to-world, 4x4, OpenCV axes, metres. A pose with inf (lost tracking) drops the frame.
* ``intrinsic/intrinsic_color.txt``, 3x3 or 4x4, in pixels of the colour images with integer pixel centres. It belongs
  to the size that most colour images have (at a tie, to the first's) and is scaled for frames of another size and the
  same shape. ``intrinsic/<name>.txt`` overrides it for one frame, at that frame's own size.
* ``intrinsic/intrinsic_depth.txt``, optional, in pixels of the depth images. If its lens differs from the colour's,
  depth is read through it (same centre, other lens, as in ScanNet's sensor). Without it the two pictures coincide.
* ``splits.json``, optional: ``{"train": [...], "test": [...]}``; frames that it leaves out need no depth.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from ...errors import PlgsError
from ..camera import Camera
from ..depth import open_depth
from ..frame import Size
from ..image_header import read_image_header
from ..layout import files_by_stem, require_all, same_shape, shown_size
from ..matrices import read_intrinsics, read_pose
from ..splits import find_split
from .capture import Capture, SceneFormat, Shot

_FOLDERS_FIX = "A scene has the folders color, depth, pose and intrinsic."


def _recognises(place: Path) -> bool:
    """Two of the folders are enough, so that a forgotten one is named."""
    return sum((place / name).is_dir() for name in ("color", "pose", "intrinsic")) >= 2


def _read(folder: Path) -> Capture:
    """Open the frames; only headers of images are read. Raises PlgsError."""
    colours = files_by_stem(folder / "color", {".jpg", ".jpeg", ".png"}, _FOLDERS_FIX)
    pose_files = files_by_stem(folder / "pose", {".txt"}, _FOLDERS_FIX)
    fix = "Add pose/<name>.txt, or take their colour images away."
    require_all(list(colours), pose_files, "pose", folder / "pose", fix)
    poses = {name: read_pose(pose_files[name]) for name in colours}
    lost = [name for name, pose in poses.items() if pose is None]
    if len(lost) == len(poses):
        raise PlgsError("every pose holds inf (lost tracking)", folder / "pose", "Give frames whose pose is known.")
    split = find_split(folder, [name for name in colours if name not in lost], lost)
    chosen = {*split.train, *split.test}
    sizes = {name: read_image_header(path).size for name, path in colours.items() if name in chosen}
    lenses = _read_lenses(folder / "intrinsic", sizes)
    depths, warnings = open_depth(folder, lenses) if (folder / "depth").is_dir() else ({}, ())
    found = [
        (name, None if pose is None else Shot(name, lenses[name].at(pose), colours[name], depths.get(name)))
        for name, pose in poses.items()
        if pose is None or name in chosen
    ]
    return Capture(found, "z", warnings, split=split)


def _read_lenses(folder: Path, sizes: Mapping[str, Size]) -> dict[str, Camera]:
    """Each frame's intrinsics at its colour image's size, as a camera at the origin."""
    if not folder.is_dir():
        raise PlgsError("a folder is missing", folder, _FOLDERS_FIX)
    shared_path = folder / "intrinsic_color.txt"
    base = Counter(sizes.values()).most_common(1)[0][0]
    shared = read_intrinsics(shared_path, base) if shared_path.is_file() else None
    lenses: dict[str, Camera] = {}
    for name, size in sizes.items():
        own_path = folder / f"{name}.txt"
        if own_path.is_file():
            lenses[name] = read_intrinsics(own_path, size)
        elif shared is None:
            raise PlgsError("the intrinsics are missing", shared_path, "Write the colour camera's 4x4 matrix there.")
        elif not same_shape(size, base):
            what = f"frame {name} is {shown_size(size)}, which is not the shape of {shown_size(base)}"
            raise PlgsError(what, shared_path, f"Give the frame intrinsics of its own, intrinsic/{name}.txt.")
        else:
            lenses[name] = shared.resized(*size)
    return lenses


FORMAT = SceneFormat("scannet", "ScanNet folders", "the folders color, pose and intrinsic", _recognises, _read)
