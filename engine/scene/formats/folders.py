"""The folders ``color/ depth/ pose/ intrinsic/`` as ScanNet exports and Panoptic Lifting's prepared scenes have them.

* ``color/<name>.jpg`` or ``.png``; the names are the frames, in natural order.
* ``depth/<name>.png``, 16 bits, millimetres along the optical axis, 0 = none; of any size with the colour's shape. The
  folder may be missing.
* ``pose/<name>.txt``, camera-to-world, 4x4, OpenCV axes, metres. A pose with inf (lost tracking) drops the frame.
* ``intrinsic/intrinsic_color.txt``, 3x3 or 4x4, in pixels of the colour images with integer pixel centres. It belongs
  to the size that most colour images have (at a tie, to the first's) and is scaled for frames of another size and the
  same shape. ``intrinsic/<name>.txt`` overrides it for one frame, at that frame's own size.
* Where the folder ``intrinsic`` has no such file, ``intrinsics_color.txt`` beside the folders, as in ScanNet's
  ``frames_25k``, in pixels of each picture.
* ``intrinsic/intrinsic_depth.txt`` or ``intrinsics_depth.txt``, optional, in pixels of the depth images. If its lens
  differs from the colour's, depth is read through it (same centre, other lens, as in ScanNet's sensor). Without it
  the two pictures coincide.
* ``splits.json``, optional: ``{"train": [...], "test": [...]}``; frames that it leaves out need no depth.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from ...posed.camera import Camera
from ...posed.image_header import read_image_header
from ...posed.matrices import read_intrinsics
from ...posed.plain_folders import NAME, read_folders, recognises
from ..depth import fault_of, open_depth
from .capture import Capture, SceneFormat, Shot


def _read(folder: Path) -> Capture:
    """Open the frames; only headers of images are read. Raises PlgsError."""
    has_own, beside = any((folder / "intrinsic").glob("*.txt")), folder / "intrinsics_color.txt"
    lens_of = partial(_lens_beside, beside) if not has_own and beside.is_file() else None
    found = read_folders(folder, lens_of)
    depths, inferred = open_depth(folder, found.cameras) if (folder / "depth").is_dir() else ({}, ())
    shots = {name: Shot(name, camera, found.pictures[name], depths.get(name)) for name, camera in found.cameras.items()}
    faults = {name: fault_of(path) for name, path in found.pictures.items() if name not in shots}
    kept = [(name, shots.get(name) or faults.get(name)) for name in found.names]
    kept = [(name, shot) for name, shot in kept if shot is not None or name in found.lost]
    return Capture(kept, "z", split=found.split, inferred=inferred)


def _lens_beside(path: Path, picture: Path) -> Camera:
    """The lens of a picture whose pixels the matrix in the file ``path`` is in. Raises PlgsError."""
    return read_intrinsics(path, read_image_header(picture).size)


FORMAT = SceneFormat(NAME, recognises, _read)
