"""frames.json: the files that an engine makes of a scene's frames for programs that cannot read the frames themselves.

Blender's Python has no OpenCV. It takes from here what lies in a video or an archive, and what has to be undistorted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import PlgsError
from ..json_file import Json, read_object, to_text
from ..scene_source import SceneSource
from .atomic import write_atomically

FORMAT = 1
FILE = "frames.json"
_FIX = "Delete the folder: it is made anew."


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
    colour: Path | None = None
    depth: Path | None = None
    depth_range: tuple[float, float] | None = None
    masks: Path | None = None


@dataclass(frozen=True)
class MadeFrames:
    """What lies in ``folder``: pictures by frame name, and the ``cloud`` (.npz with xyz float32 [N, 3] metres and rgb
    uint8 [N, 3]), None where it was not asked for. ``total`` counts the scene's frames.
    """

    folder: Path
    source: SceneSource
    frames: Mapping[str, MadeFrame] = field(default_factory=dict)
    cloud: Path | None = None
    total: int = 0

    @property
    def is_complete(self) -> bool:
        """Whether every frame of the scene is named."""
        return 0 < self.total <= len(self.frames)

    def write(self) -> None:
        """Put frames.json into the folder. Raises OSError."""
        frames = {name: _to_json(frame, self.folder) for name, frame in self.frames.items()}
        cloud = None if self.cloud is None else _inside(self.cloud, self.folder)
        content: dict[str, object] = {"format": FORMAT, "source": self.source.as_json(), "frames": frames}
        content |= {"cloud": cloud, "total": self.total}
        write_atomically(self.folder / FILE, to_text(content))

    @classmethod
    def read(cls, folder: Path) -> MadeFrames:
        """Read the frames.json of a folder. Raises PlgsError when it is missing, of another version, or damaged."""
        path = folder / FILE
        content: dict[str, Any] = read_object(path, _FIX)
        if content.get("format") != FORMAT:
            raise PlgsError(f"has format {content.get('format')!r}, this version reads {FORMAT}", path, _FIX)
        try:
            source = SceneSource.from_json(content["source"])
            frames = {str(name): _from_json(each, folder) for name, each in content["frames"].items()}
            cloud = content["cloud"]
            return cls(folder, source, frames, None if cloud is None else folder / cloud, int(content["total"]))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise PlgsError(f"cannot be read ({error!r})", path, _FIX) from error


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


def _to_json(frame: MadeFrame, folder: Path) -> dict[str, Json]:
    files = {"colour": frame.colour, "depth": frame.depth, "masks": frame.masks}
    content: dict[str, Json] = {name: _inside(path, folder) for name, path in files.items() if path is not None}
    content |= {"lens": [*frame.lens], "pose": [*frame.pose], "held_out": frame.held_out}
    if frame.picture is not None:
        content["picture"] = str(frame.picture)
    if frame.depth_range is not None:
        content["depth_range"] = [*frame.depth_range]
    return content


def _from_json(content: Mapping[str, Any], folder: Path) -> MadeFrame:
    files = {name: folder / content[name] for name in ("colour", "depth", "masks") if name in content}
    span = content.get("depth_range")
    lens, pose = (tuple(float(number) for number in content[name]) for name in ("lens", "pose"))
    if len(lens) != 6 or len(pose) != 16:
        raise ValueError("a frame has no camera")
    return MadeFrame(
        lens=lens,
        pose=pose,
        held_out=bool(content["held_out"]),
        picture=_path(content.get("picture")),
        depth_range=None if span is None else (float(span[0]), float(span[1])),
        **files,
    )


def _inside(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)
