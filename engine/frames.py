"""Write a scene's frames for any program in one pass: undistorted pictures, coloured depth and masks, a cloud."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import PlgsError
from .job import write_atomically
from .job.own_files import OwnFiles
from .job.progress import Progress, unwatched
from .known_scene import MadeFrame, MadeFrames, is_newer, made_of, stored_scene
from .scene import Camera, Frame, Scene
from .scene.frame_colours import depth_colours, mask_colours
from .scene.pixels import write_image
from .scene_source import SceneSource

_CELLS_DEEP = 200.0
"""Cells per median depth of the first frame: a cell is about a centimetre in a room."""
_SIDE = 2**20  # so that three coordinates of 21 bits fit into an int64
"""Cells in each direction along an axis."""


@dataclass(frozen=True, eq=False)
class ColouredCloud:
    """A coloured point cloud: ``xyz`` float32 [N, 3] world metres, ``rgb`` uint8 [N, 3] sRGB."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]


class CloudBuilder:
    """Builds a point cloud with one point, the mean of its pixels, for each cell of a grid. Whenever more than ``cap``
    cells are filled, the grid becomes twice as coarse, so that memory stays bounded."""

    def __init__(self, cap: int = 400_000) -> None:
        self._cap, self._spacing = cap, 0.0
        self._cells = np.zeros((0, 3), np.int64)
        self._sums = np.zeros((0, 7))  # x y z r g b count

    def add(self, camera: Camera, depth: NDArray[np.float32], colour: NDArray[np.uint8], stride: int = 1) -> None:
        """Add a frame: depth float32 [H, W] metres (0 = none) and colour uint8 [H, W, 3], of ``camera``'s size. Every
        ``stride``-th row and column is taken."""
        seen = depth[::stride, ::stride] > 0.0
        xyz = camera.unproject(depth)[::stride, ::stride][seen]
        if not len(xyz):
            return
        if not self._spacing:
            self._spacing = float(np.median(depth[depth > 0.0])) / _CELLS_DEEP
        cells = np.clip(np.floor(xyz / self._spacing), -_SIDE, _SIDE - 1).astype(np.int64)
        sums = np.concatenate([xyz, colour[::stride, ::stride][seen], np.ones((len(xyz), 1))], axis=1)
        self._merge(np.concatenate([self._cells, cells]), np.concatenate([self._sums, sums]))
        while len(self._cells) > self._cap:
            self._spacing *= 2.0
            self._merge(self._cells // 2, self._sums)  # rounds down, for negative cells as well

    def cloud(self) -> ColouredCloud:
        """Return the cloud of all frames so far."""
        mean = self._sums[:, :6] / np.maximum(self._sums[:, 6:], 1.0)
        return ColouredCloud(mean[:, :3].astype(np.float32), np.rint(mean[:, 3:]).astype(np.uint8))

    def _merge(self, cells: NDArray[np.int64], sums: NDArray[np.float64]) -> None:
        """Keep one row per cell, in the order of the cells. The ``sums`` [N, 7] of equal ``cells`` [N] are added."""
        x, y, z = (cells + _SIDE).T
        _, first, cell = np.unique((x * 2 * _SIDE + y) * 2 * _SIDE + z, return_index=True, return_inverse=True)
        self._cells = cells[first]
        columns = [np.bincount(cell.ravel(), column, len(first)) for column in sums.T]  # faster than np.add.at
        self._sums = np.stack(columns, axis=1)


KINDS = ("colour", "depth", "masks", "cloud")

_CLOUD_FRAMES, _CLOUD_PIXELS = 300, 8_000_000
"""Approximate maximum numbers of frames, evenly spread, and of pixels for the cloud."""


def make_frames(
    scene: Scene,
    source: SceneSource,
    folder: Path,
    *,
    kinds: Collection[str] = KINDS,
    names: Collection[str] | None = None,
    progress: Progress = unwatched,
) -> MadeFrames:
    """Write the ``kinds`` of files (some of KINDS) of the frames ``names`` (None: all) into ``folder``. frames.json
    lists all cameras before the first picture is made, and the files at the end. A picture that an image file shows
    unchanged is not written. Files of an earlier run are kept, unless their source is newer or the frame's camera
    differs, which means that another scene is now at the path. Other people's files are always kept (see `OwnFiles`).
    Raises PlgsError if the folder holds something else, a frame is missing, the scene has none of ``kinds``, or a file
    of the scene is bad. Bad depth for the cloud is reported after the pictures are written."""
    made, own = made_of(folder, source), OwnFiles(folder).begin("frames", {"scene": str(source.scene)}, replaces=True)
    known = {frame.name for frame in scene.frames}
    chosen = known if names is None else {*names}
    if strange := sorted(chosen - known):
        fix = "Give names as inspect and Blender's cameras show them."
        raise PlgsError("not-a-frame", "this is not a frame of the scene", strange[0], fix)
    _refuse_nothing(scene, chosen, kinds)
    stored = stored_scene(scene, scene.frames)
    same = set() if made is None else {frame.name for frame in {*stored.frames} & {*made.scene.frames}}
    done = {} if made is None else {name: each for name, each in made.frames.items() if name in same}
    cloud = None if made is None or len(same) < len(stored.frames) else made.cloud
    with own:
        points = None
        if scene.points is not None and len(scene.points):
            points = _write_points(folder / "points.npz", scene.points.xyz.astype(np.float32), scene.points.rgb)
        made = MadeFrames(folder, source, stored, done, cloud, points)
        made.write()
        in_cloud = cloud_strides(scene.frames) if "cloud" in kinds else {}
        builder, problem = CloudBuilder(), None
        todo = [frame for frame in scene.frames if frame.name in chosen or frame.name in in_cloud]
        for position, frame in enumerate(todo):
            if frame.name in chosen:
                done[frame.name] = _make(scene, frame, folder, kinds, done.get(frame.name, MadeFrame()))
            if frame.name in in_cloud and problem is None:
                try:
                    add_to_cloud(builder, frame, in_cloud[frame.name])
                except PlgsError as error:
                    problem = error  # raised below, after all pictures are made
            progress(position + 1, len(todo))
        is_new = in_cloud and problem is None
        found = builder.cloud()
        cloud = _write_points(folder / "cloud.npz", found.xyz, found.rgb) if is_new else made.cloud
        result = replace(made, frames=done, cloud=cloud)
        result.write()
    own.complete()
    if problem is not None:
        raise problem
    return result


def _refuse_nothing(scene: Scene, chosen: Collection[str], kinds: Collection[str]) -> None:
    frames = [frame for frame in scene.frames if frame.name in chosen]
    there = {
        "colour": True,
        "depth": any(frame.read_depth is not None for frame in frames),
        "masks": any(frame.read_mask is not None for frame in frames),
        "cloud": any(frame.read_depth is not None for frame in scene.frames),
    }
    if kinds and not any(there[kind] for kind in kinds):
        lacking = " and no ".join(dict.fromkeys("depth" if kind == "cloud" else kind for kind in kinds))
        fix = "Name other things to make, or name their folders with --masks or --depth."
        what = f"there are no frames to write, as these have no {lacking}"
        raise PlgsError("nothing-to-write", what, scene.folder, fix, option="--masks --depth")


def _make(scene: Scene, frame: Frame, folder: Path, kinds: Collection[str], made: MadeFrame) -> MadeFrame:
    """Write one frame's pictures into ``folder``. Returns them together with those of an earlier run, ``made``."""
    if "colour" in kinds and not frame.file_shows_colour:
        path = folder / "color" / f"{frame.name}.jpg"
        if made.colour is None or not is_newer(path, frame.colour_path):
            write_image(path, frame.read_colour(None))
        made = replace(made, colour=path)
    if "depth" in kinds and frame.read_depth is not None:
        path = folder / "depth" / f"{frame.name}.png"
        if made.depth_range is None or not is_newer(path, frame.depth_path or frame.colour_path):
            drawn = depth_colours(frame.read_depth(None))
            write_image(path, drawn.rgb)
            made = replace(made, depth_range=(drawn.near, drawn.far))
        made = replace(made, depth=path)
    if "masks" in kinds and frame.read_mask is not None:
        # Only its reader knows the file of a mask, so masks are drawn again each time.
        path = folder / "masks" / f"{frame.name}.png"
        write_image(path, mask_colours(frame.read_mask(None), scene.classes))
        made = replace(made, masks=path)
    return made


def cloud_strides(frames: Sequence[Frame]) -> dict[str, int]:
    """Return the names of the frames for the cloud, evenly spread over those with depth, each with the step between the
    pixels of its picture that are used."""
    deep = [frame for frame in frames if frame.read_depth is not None]
    chosen = deep[:: -(-len(deep) // _CLOUD_FRAMES) or 1]  # a slice's step cannot be 0
    share = len(chosen) / _CLOUD_PIXELS
    return {frame.name: max(1, round((frame.size[0] * frame.size[1] * share) ** 0.5)) for frame in chosen}


def add_to_cloud(builder: CloudBuilder, frame: Frame, stride: int) -> None:
    """Add points of a frame's depth, as dense as every ``stride``-th pixel of its picture, which often has more pixels
    than the depth. Raises PlgsError for bad files, OSError."""
    depth = frame.depth(None)
    height, width = depth.shape
    # The stride is that of the picture; depth often has fewer pixels.
    own = max(1, round(stride * width / frame.camera.width))
    builder.add(frame.camera.resized(width, height), depth, frame.read_colour((width, height)), own)


def _write_points(path: Path, xyz: NDArray[np.float32], rgb: NDArray[np.uint8]) -> Path:
    """Write points ``xyz`` [N, 3] metres with colours ``rgb`` [N, 3] sRGB, and return the path."""
    write_atomically(path, lambda part: np.savez(part, xyz=xyz, rgb=rgb))
    return path
