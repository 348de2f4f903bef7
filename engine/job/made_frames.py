"""frames.json: the files that an engine makes of a scene's frames for programs that cannot read the frames themselves.

Blender's Python has no OpenCV. It takes from here what lies in a video or an archive, and what has to be undistorted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import PlgsError
from ..records import read_record, record_text
from ..scene_source import SceneSource
from .atomic import write_atomically

FILE = "frames.json"
_FIX = "Delete the folder: it is made anew."
_INSIDE = {"inside": True}


@dataclass(frozen=True)
class MadeFrame:
    """One frame's pictures, None where it has none: its ``colour`` undistorted, its ``depth`` and ``masks`` drawn in
    colours.

    ``depth_range`` is the nearest and the farthest depth in metres that the drawing distinguishes. ``lens`` is width,
    height, fx, fy, cx, cy in pixels (centres at +0.5); ``pose`` is camera-to-world, 16 numbers row by row, OpenCV axes,
    metres. Both are for scenes that Blender cannot open. ``picture`` is the scene's own image file that shows what
    ``colour`` would, None when there is no such file.
    """

    lens: tuple[float, ...] = ()
    pose: tuple[float, ...] = ()
    held_out: bool = False
    picture: Path | None = None
    colour: Path | None = field(default=None, metadata=_INSIDE)
    depth: Path | None = field(default=None, metadata=_INSIDE)
    depth_range: tuple[float, float] | None = None
    masks: Path | None = field(default=None, metadata=_INSIDE)


@dataclass(frozen=True)
class MadeFrames:
    """What lies in ``folder``: pictures by frame name, and the ``cloud`` (.npz with xyz float32 [N, 3] metres and rgb
    uint8 [N, 3]), None where it was not asked for. ``total`` counts the scene's frames.
    """

    folder: Path = field(metadata={"apart": True})
    source: SceneSource
    frames: Mapping[str, MadeFrame] = field(default_factory=dict)
    cloud: Path | None = field(default=None, metadata=_INSIDE)
    total: int = 0

    @property
    def is_complete(self) -> bool:
        """Whether every frame of the scene is named."""
        return 0 < self.total <= len(self.frames)

    def write(self) -> None:
        """Put frames.json into the folder. Raises OSError."""
        write_atomically(self.folder / FILE, record_text(self, self.folder))

    @classmethod
    def read(cls, folder: Path) -> MadeFrames:
        """Read the frames.json of a folder. Raises PlgsError when it is missing, of another version, or damaged."""
        made = read_record(cls, folder / FILE, _FIX, folder=folder)
        for name, frame in made.frames.items():
            if len(frame.lens) != 6 or len(frame.pose) != 16:
                raise PlgsError(f"frame {name!r} has no camera", folder / FILE, _FIX)
        return made


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
    raise PlgsError("is there already, and holds something else", folder, "Name another folder.")


def is_newer(path: Path, source: Path) -> bool:
    """Whether a file was made after its source was last changed."""
    try:
        return path.stat().st_mtime >= source.stat().st_mtime
    except OSError:
        return False
