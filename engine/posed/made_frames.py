"""frames.json: the files that an engine makes of a scene's frames for programs that cannot read the frames themselves.

Blender's Python has no OpenCV. It takes from here the cameras of all layouts except plain folders, and pictures that
lie in a video or an archive, or have to be undistorted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import PlgsError
from ..job.atomic import write_atomically
from ..records import read_record, record_text
from ..scene_source import SceneSource
from .scene_record import StoredScene

FILE = "frames.json"
VERSION = 2
"""The version of frames.json. Version 1 had no cameras of frames without a picture."""
_FIX = "Delete the folder; it will be made again."
_INSIDE = {"inside": True}


@dataclass(frozen=True)
class MadeFrame:
    """One frame's pictures, None where it has none: its ``colour`` undistorted, its ``depth`` and ``masks`` drawn in
    colours. ``depth_range`` is the nearest and the farthest depth in metres that the drawing distinguishes.
    """

    colour: Path | None = field(default=None, metadata=_INSIDE)
    depth: Path | None = field(default=None, metadata=_INSIDE)
    depth_range: tuple[float, float] | None = None
    masks: Path | None = field(default=None, metadata=_INSIDE)


@dataclass(frozen=True)
class MadeFrames:
    """What lies in ``folder``: the cameras of all frames of the ``scene``, and the pictures by frame name. ``cloud`` is
    made of depth, ``points`` are those of the reconstruction behind the poses: .npz files with xyz float32 [N, 3]
    metres and rgb uint8 [N, 3], None where there are none.
    """

    folder: Path = field(metadata={"apart": True})
    source: SceneSource
    scene: StoredScene
    frames: Mapping[str, MadeFrame] = field(default_factory=dict)
    cloud: Path | None = field(default=None, metadata=_INSIDE)
    points: Path | None = field(default=None, metadata=_INSIDE)

    def write(self) -> None:
        """Put frames.json into the folder. Raises OSError."""
        write_atomically(self.folder / FILE, record_text(self, self.folder, VERSION))

    @classmethod
    def read(cls, folder: Path) -> MadeFrames:
        """Read the frames.json of a folder. Raises PlgsError when it is missing, of another version, or damaged."""
        return read_record(cls, folder / FILE, _FIX, VERSION, folder=folder)


def made_of(folder: Path, source: SceneSource) -> MadeFrames | None:
    """What an earlier run made of this very scene in ``folder``; None when nothing is there. Raises PlgsError when the
    folder holds something else.
    """
    if not folder.exists():
        return None
    if (folder / FILE).is_file():
        made = MadeFrames.read(folder)
        if made.source == source:
            return made
    elif folder.is_dir() and not any(folder.iterdir()):
        return None
    raise PlgsError("the folder exists already and holds something else", folder, "Name another folder.")


def is_newer(path: Path, source: Path) -> bool:
    """Whether a file was made after its source was last changed."""
    try:
        return path.stat().st_mtime >= source.stat().st_mtime
    except OSError:
        return False
