"""The data of a diagnosis: depth (`Look`) and photos of at most 120 frames, and points of each depth projected into
other frames, under an assumption about what the scene's numbers mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..scene import Camera, Frame, Scene, Size, read_ahead, size_within
from ..scene.depth import compared
from ..scene.pixels import resize_nearest

Floats = NDArray[np.float64]
Pairs = NDArray[np.int64]  # the rows of two looks each, [P, 2]


class Sample(NamedTuple):
    """Which frames are examined: all if there are at most ``most``, else ``groups`` groups spread over the recording,
    each with the frames at the offsets ``steps``. Neighbours show small errors, distant views of a surface large
    ones."""

    most: int
    groups: int
    steps: tuple[int, ...]

    def numbers(self, count: int) -> list[int]:
        """Return the indices, ascending, of the frames to examine among ``count``."""
        if count <= self.most:
            return [*range(count)]
        starts = np.linspace(0, count - 1, self.groups).round().astype(int)
        return sorted({int(min(start + step, count - 1)) for start in starts for step in self.steps})


MANY, FEW = Sample(120, 24, (0, 1, 3, 7, 15)), Sample(36, 12, (0, 1, 2))
_FEWEST_PAIRS, _FEWEST_LOOKS = 12, 6
_WIDEST = 640  # the width in pixels to which depth and pictures are reduced
_PHOTO_WIDTH = _MASK_WIDTH = 320
_POINTS = 400  # the number of points that each look compares with other views
_SMOOTH_AROUND = 1.05  # largest ratio of the depths around a point; above it, the pixels lie on both sides of an edge


@dataclass(frozen=True, eq=False)
class Look:
    """A frame whose depth is loaded. ``number`` is its index in the scene's frames. ``depth`` float32 [H, W] is in the
    scene's metres, 0 = none; ``camera`` has its size. ``points`` int32 [N, 2] (column, row) lie on smooth surfaces,
    spread over the picture; these points are compared with other frames."""

    number: int
    frame: Frame
    camera: Camera
    depth: NDArray[np.float32]
    points: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Photo:
    """The picture of the scene's frame ``number``. ``grey`` uint8 [H, W] is at most 320 pixels wide."""

    number: int
    name: str
    grey: NDArray[np.uint8]


def pairs_of(count: int) -> Pairs:
    """Return the pairs (from, to) of frames to compare, int64 [P, 2] (see `compared`), in alternating directions."""
    # Directions alternate, so that both the points and the depth of each look are used.
    return np.array([(i, j) if (i + j) % 2 else (j, i) for i, j in compared(count)], np.int64).reshape(-1, 2)


def load_looks(frames: Sequence[Frame], sample: Sample) -> list[Look]:
    """Load the depth of the sample's frames that have depth. Raises PlgsError for bad files."""
    looks, kernel = [], np.ones((3, 3), np.uint8)
    numbers = [number for number in sample.numbers(len(frames)) if frames[number].read_depth is not None]
    for number, depth in zip(numbers, read_ahead([frames[number] for number in numbers], _small_depth), strict=True):
        nearest, farthest = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
        smooth = (nearest > 0.0) & (farthest < _SMOOTH_AROUND * nearest)
        smooth[[0, -1]] = smooth[:, [0, -1]] = False  # their neighbours outside are unknown
        rows, columns = np.nonzero(smooth)
        chosen = np.random.default_rng(number).permutation(len(rows))[:_POINTS]  # the same each time
        if len(chosen):
            points, frame = np.stack([columns[chosen], rows[chosen]], axis=-1).astype(np.int32), frames[number]
            looks.append(Look(number, frame, frame.camera.resized(*depth.shape[::-1]), depth, points))
    return looks


def _small_depth(frame: Frame) -> NDArray[np.float32]:
    depth = frame.depth(None)
    step = _stride_for(depth.shape[1])  # the middle pixel of each block, so that nothing moves by half a pixel
    rows, columns = (np.arange(length // step) * step + step // 2 for length in depth.shape)
    return np.ascontiguousarray(depth[rows[:, None], columns])


def load_photos(frames: Sequence[Frame], sample: Sample) -> dict[int, Photo]:
    """Load the pictures of the sample's frames, by the frames' indices. Raises PlgsError for bad files."""
    numbers = sample.numbers(len(frames))
    greys = read_ahead([frames[number] for number in numbers], _small_grey)
    return {number: Photo(number, frames[number].name, grey) for number, grey in zip(numbers, greys, strict=True)}


def _small_grey(frame: Frame) -> NDArray[np.uint8]:
    grey = cv2.cvtColor(frame.read_colour(None), cv2.COLOR_RGB2GRAY)
    step = _stride_for(grey.shape[1])
    grey = cv2.resize(grey, (grey.shape[1] // step, grey.shape[0] // step), interpolation=cv2.INTER_AREA)
    width = min(grey.shape[1], _PHOTO_WIDTH)
    size = width, round(grey.shape[0] * width / grey.shape[1])
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _stride_for(width: int) -> int:
    """Return the odd step between pixels that reduces a picture to at most 640 pixels across."""
    step = -(-width // _WIDEST)
    return step + 1 - step % 2


Lens = Floats  # fx, fy, cx, cy as fractions of the picture's width and height: float64 [..., 4]

_AGREES_WITHIN = 0.05  # a fraction of the depth; a larger difference shows another surface, or an error
_SMOOTH = 1.1  # largest ratio of the depths between which depth is interpolated
_NORMAL_GRAIN = 160  # a normal is measured over a 160th of the picture's width and height to each side
_OPENGL = np.diag([1.0, -1.0, -1.0])


class Assumption(NamedTuple):
    """What the numbers of a scene might mean. The defaults are how the scene was read. ``inverted``: poses are
    world-to-camera. ``opengl``: cameras have y up and z backward. ``unit``: factor of depth. ``ray``: 1 if depth is the
    distance to the camera. ``lens_scale``: factor of fx, fy, cx, cy. ``focal``: further factor of fx and fy.
    ``aspect``: further factor of fx. ``shift``: added to the principal point, as fractions of the picture. ``length``:
    factor of the cameras' positions. ``lag``: a frame's pose is that of the frame this many frames later. ``mirrored``:
    pictures and depth have left and right exchanged."""

    inverted: bool = False
    opengl: bool = False
    unit: float = 1.0
    ray: float = 0.0
    lens_scale: float = 1.0
    focal: float = 1.0
    aspect: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    length: float = 1.0
    lag: int = 0
    mirrored: bool = False


class Comparison(NamedTuple):
    """M points of the first frame of each of P pairs, projected into the second. Arrays are [P, M]. ``error`` float64:
    logarithm of the depth seen over the depth expected, nan where the second frame has none. ``agrees`` float64: 1 for
    no error, 0 from 5 % on and without depth. ``known`` bool: the point exists. ``place`` float64 [P, M, 2]: in
    fractions of the second picture, nan behind its camera."""

    error: Floats
    agrees: Floats
    known: NDArray[np.bool_]
    place: Floats


class Surface(NamedTuple):
    """The surface of a frame's depth where points project to it. ``normal`` float64 [N, 3] is in the camera's axes.
    ``distance`` float64 [N] is the points' height above the surface in metres. Both are nan without a surface."""

    distance: Floats
    normal: Floats


class Views:
    """The loaded depths as arrays, so that all pairs are compared at once. ``turn`` float64 [3, 3] is the rotation that
    made the world upright when the scene was opened. Assumptions about poses are about the poses as they were written,
    before that rotation. ``recorded`` float64 [N, 4, 4] are the poses of all frames of the scene."""

    def __init__(self, looks: Sequence[Look], turn: Floats, recorded: Floats) -> None:
        self.looks, self.turn, self.recorded = looks, turn, recorded
        most = max(len(look.points) for look in looks)
        self.size = np.array([(look.camera.width, look.camera.height) for look in looks], np.float64)
        cameras = [look.camera for look in looks]
        self.lens = np.array([(c.fx / c.width, c.fy / c.height, c.cx / c.width, c.cy / c.height) for c in cameras])
        self.numbers = np.array([look.number for look in looks])
        self.places = np.zeros((len(looks), most, 2))
        self.values = np.zeros((len(looks), most))
        for row, look in enumerate(looks):
            columns, rows = look.points.T
            self.places[row, : len(look.points)] = (look.points + 0.5) / self.size[row]
            self.values[row, : len(look.points)] = look.depth[rows, columns]
        sizes = np.array([look.depth.size for look in looks])
        self._starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        self._pixels = np.concatenate([look.depth.ravel() for look in looks])

    def poses_of(self, assumed: Assumption) -> Floats:
        """Return camera-to-world poses in the scene's world under an assumption, float64 [F, 4, 4]."""
        meant = np.clip(self.numbers + assumed.lag, 0, len(self.recorded) - 1)
        return assumed_poses(self.recorded[meant], self.turn, assumed)

    def compare(self, pairs: Pairs, assumed: Assumption, points: int | None = None) -> Comparison:
        """Project the first ``points`` points (None: all) of each pair's first frame into its second; pairs [P, 2]."""
        lens, poses = lens_under(self.lens, assumed), self.poses_of(assumed)
        one, other = pairs[:, 0], pairs[:, 1]
        world, known = self.world_points(assumed, lens, poses, points)
        rotation, centre = poses[other, :3, :3], poses[other, :3, 3]
        local = np.matmul(world[one] - centre[:, None], rotation)  # rows times R: from world to camera
        z = local[..., 2]
        front = z > 1e-6
        safe = np.where(front, z, 1.0)  # avoids a division by 0; what is behind is masked below
        place = local[..., :2] / safe[..., None] * lens[other, None, :2] + lens[other, None, 2:]
        seen = self.depth_at(other, place, front & known[one])
        seen = planar(seen, place, lens[other], assumed)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.where(seen > 0.0, np.log(seen / safe), np.nan)
        share = np.square(np.nan_to_num(error, nan=1.0) / _AGREES_WITHIN)  # nan: nothing seen, so no agreement
        agrees = np.square(np.clip(1.0 - share, 0.0, 1.0))  # Tukey's biweight: smooth for fits, 0 for outliers
        place = np.where(front[..., None], place, np.nan)
        return Comparison(error, agrees, known[one], place)

    def world_points(
        self, assumed: Assumption, lens: Lens, poses: Floats, points: int | None = None
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the frames' first ``points`` in the world, float64 [F, M, 3], and whether each exists, bool [F, M]."""
        places, values = self.places[:, :points], self.values[:, :points]
        depth = planar(values, places, lens, assumed)
        rays = (places - lens[:, None, 2:]) / lens[:, None, :2]
        local = np.concatenate([rays, np.ones_like(rays[..., :1])], -1) * depth[..., None]
        return np.matmul(local, poses[:, :3, :3].swapaxes(1, 2)) + poses[:, None, :3, 3], values > 0.0

    def depth_at(self, looks: NDArray[np.int64], place: Floats, wanted: NDArray[np.bool_]) -> Floats:
        """Return the depth, interpolated, at ``place`` [P, M, 2] of pictures ``looks`` [P] where ``wanted``; 0 at edges
        and outside."""
        found = np.zeros(wanted.shape)
        width, height = self.size[looks, 0].astype(np.int64)[:, None], self.size[looks, 1].astype(np.int64)[:, None]
        x, y = place[..., 0] * width - 0.5, place[..., 1] * height - 0.5
        inside = wanted & (x >= 0.0) & (y >= 0.0) & (x < width - 1) & (y < height - 1)
        x, y, across = x[inside], y[inside], np.broadcast_to(width, inside.shape)[inside]
        left, top = x.astype(np.int64), y.astype(np.int64)
        right, down = x - left, y - top
        index = np.broadcast_to(self._starts[looks][:, None], inside.shape)[inside] + top * across + left
        corners = [self._pixels[index + step] for step in (0, 1, across, across + 1)]
        nearest, farthest = np.minimum.reduce(corners), np.maximum.reduce(corners)
        smooth = (nearest > 0.0) & (farthest < _SMOOTH * nearest)
        # A plane is linear in 1 / depth.
        inverse = [1.0 / np.where(smooth, corner, 1.0).astype(np.float64) for corner in corners]
        upper = inverse[0] * (1.0 - right) + inverse[1] * right
        lower = inverse[2] * (1.0 - right) + inverse[3] * right
        found[inside] = np.where(smooth, 1.0 / (upper * (1.0 - down) + lower * down), 0.0)
        return found

    def surface_at(self, look: int, local: Floats, assumed: Assumption, lens: Lens) -> Surface:
        """Return the surface of frame ``look`` onto which ``local``, points float64 [N, 3] in camera axes, project."""
        safe = np.where(local[:, 2] > 1e-6, local[:, 2], 1.0)
        place = local[:, :2] / safe[:, None] * lens[:2] + lens[2:]
        step = np.maximum(1.0, np.round(self.size[look] / _NORMAL_GRAIN)) / self.size[look]
        moves = np.array([(0.0, 0.0), (step[0], 0.0), (-step[0], 0.0), (0.0, step[1]), (0.0, -step[1])])
        places = place[None] + moves[:, None]
        wanted = np.broadcast_to(local[:, 2] > 1e-6, places.shape[:2])
        depth = self.depth_at(np.full(len(moves), look), places, wanted)
        depth = planar(depth, places, np.broadcast_to(lens, (len(moves), 4)), assumed)
        rays = np.concatenate([(places - lens[2:]) / lens[:2], np.ones((*places.shape[:2], 1))], -1)
        at, right, left, down, up = rays * depth[..., None]
        normal = np.cross(down - up, right - left)  # towards the camera
        length = np.linalg.norm(normal, axis=1)
        sound = (depth > 0.0).all(0) & (length > 1e-12)
        normal = normal / np.where(sound, length, 1.0)[:, None]
        return Surface(np.where(sound, (normal * (local - at)).sum(1), np.nan), normal)


def lens_under(lens: Lens, assumed: Assumption) -> Lens:
    """Return the intrinsics that ``lens`` [F, 4] (fx, fy, cx, cy) has if an `Assumption` is true, in the same form."""
    meant = lens.copy()
    meant *= assumed.lens_scale
    meant[:, :2] *= assumed.focal
    meant[:, 0] *= assumed.aspect
    meant[:, 2:] += assumed.shift
    if assumed.mirrored:
        meant[:, 0], meant[:, 2] = -meant[:, 0], 1.0 - meant[:, 2]  # x becomes 1 - x
    return meant


def assumed_poses(poses: Floats, turn: Floats, assumed: Assumption) -> Floats:
    """Return camera-to-world poses [F, 4, 4] under an assumption, without its lag. ``turn`` is that of ``Views``."""
    if not (assumed.inverted or assumed.opengl or assumed.length != 1.0):
        return poses
    rotation, centre = turn.T @ poses[:, :3, :3], poses[:, :3, 3] @ turn  # as written, see Views
    if assumed.inverted:
        rotation = rotation.swapaxes(1, 2)
        centre = -np.einsum("fij,fj->fi", rotation, centre)
    if assumed.opengl:
        rotation = rotation @ _OPENGL
    meant = poses.copy()
    meant[:, :3, :3], meant[:, :3, 3] = turn @ rotation, assumed.length * centre @ turn.T
    return meant


def planar(depth: Floats, place: Floats, lens: Lens, assumed: Assumption) -> Floats:
    """Return planar depth in metres from a scene's values [..., M] at ``place`` [..., M, 2], under an assumption."""
    if assumed.ray:
        rays = (place - lens[:, None, 2:]) / lens[:, None, :2]
        length = np.sqrt((rays**2).sum(-1) + 1.0)
        depth = depth * length ** (-assumed.ray)  # a fit tries fractions, too
    return depth * assumed.unit


class Gain(NamedTuple):
    """The effect of a change: the mean over pairs ``before`` and ``after``, the mean gain of frames, and that in
    standard errors (``certainty``)."""

    before: float
    after: float
    mean: float
    certainty: float


@dataclass(frozen=True, eq=False)
class Examined:
    """The loaded part of a scene. ``looks`` are the frames with depth, compared in ``pairs`` int64 [P, 2]; ``photos``
    are by frame index. Masks are read scaled down to fit into the size ``masks_within`` (None: at their own)."""

    scene: Scene
    looks: list[Look]
    views: Views
    pairs: Pairs
    photos: dict[int, Photo]
    masks_within: Size | None = None

    def name(self, row: int) -> str:
        """Return the name of the frame in this row of ``looks``."""
        return self.looks[row].frame.name

    def photo(self, row: int) -> Photo:
        """Return the photo of the frame in this row of ``looks``."""
        return self.photos[self.looks[row].number]

    @cached_property
    def class_maps(self) -> list[NDArray[np.int32]] | None:
        """Return class ids of each look's mask, int32 [H, W <= 320]; None if one is missing. Raises PlgsError if
        bad."""
        if any(look.frame.read_mask is None for look in self.looks):
            return None
        maps, within = [], self.masks_within
        for frame in (look.frame for look in self.looks):
            classes = frame.mask(None if within is None else size_within(frame.size, within)).class_map()
            height, width = classes.shape
            size = (_MASK_WIDTH, max(1, round(height * _MASK_WIDTH / width)))
            maps.append(resize_nearest(classes, size) if width > _MASK_WIDTH else classes)
        return maps

    def mean_by_look(self, values: Floats) -> Floats:
        """Return each frame's mean of the ``values`` [P] of its pairs, for frames with any, so that each counts
        once."""
        total, count = np.zeros(len(self.looks)), np.zeros(len(self.looks))
        known = np.isfinite(values)
        for column in (0, 1):
            np.add.at(total, self.pairs[known, column], values[known])
            np.add.at(count, self.pairs[known, column], 1.0)
        return total[count > 0] / count[count > 0]

    def gained(self, before: Floats, after: Floats) -> Gain | None:
        """Return the effect of a change of pairs' values [P] from ``before`` to ``after``; None with too few pairs."""
        gains = after - before  # nan where one of them is unknown
        known, by_look = np.isfinite(gains), self.mean_by_look(gains)
        if known.sum() < _FEWEST_PAIRS or len(by_look) < _FEWEST_LOOKS:
            return None
        mean, error = float(by_look.mean()), float(by_look.std(ddof=1)) / np.sqrt(len(by_look))
        return Gain(float(before[known].mean()), float(after[known].mean()), mean, mean / max(error, 1e-9))

    def telling_pair(self, assumed: Assumption) -> tuple[int, int]:
        """Return two frames for a picture: they see much of the same surface, from places as far apart as possible."""
        comparison = self.views.compare(self.pairs, assumed)
        share = comparison.agrees.sum(1) / np.maximum(comparison.known.sum(1), 1)
        centres = self.views.poses_of(assumed)[:, :3, 3]
        apart = np.linalg.norm(centres[self.pairs[:, 0]] - centres[self.pairs[:, 1]], axis=1)
        best = int(np.argmax(share * np.sqrt(apart + 1e-9)))
        return int(self.pairs[best, 0]), int(self.pairs[best, 1])


def examine(scene: Scene, sample: Sample = MANY, masks_within: Size | None = None) -> Examined | None:
    """Load the frames of a ``sample`` to compare, masks within a size. None if fewer than three have depth. Raises
    PlgsError for a bad file."""
    looks = load_looks(scene.frames, sample)
    if len(looks) < 3:
        return None
    turn = np.eye(3) if scene.turn is None else scene.turn
    recorded = np.stack([frame.camera.camera_to_world for frame in scene.frames])
    photos = load_photos(scene.frames, sample)
    return Examined(scene, looks, Views(looks, turn, recorded), pairs_of(len(looks)), photos, masks_within)
