"""A room that every format's sample shows: known surfaces, ray-cast, written by nobody's reader read backwards.

The room spans x -1..3, y -2..1.5, z 0..2.4 metres, z up, with a box in it. Each face has a colour of its own. A view
says where its camera stands and which way its right, up and forward point; each sample composes its format's pose from
these by itself. ``check_on_room`` asks the one question: do the points of all frames' depth lie on the room's
surfaces, in the right colours?
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.scene import Scene
from tests.tiny_scene import box_hits

LOW, HIGH = np.array([-1.0, -2.0, 0.0]), np.array([3.0, 1.5, 2.4])
BOX_LOW, BOX_HIGH = np.array([0.9, -0.7, 0.0]), np.array([1.7, 0.1, 1.1])
WALL_COLOURS = np.array(
    [[200, 60, 60], [60, 160, 70], [70, 90, 200], [190, 170, 50], [120, 80, 50], [225, 225, 230]], np.uint8
)
"""sRGB of the faces x low, x high, y low, y high, floor, ceiling; the box has the same, darker."""
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Lens:
    """A pinhole of a ``width`` x ``height`` picture; the principal point in pixels, pixel centres at +0.5."""

    width: int = 64
    height: int = 48
    fx: float = 55.0
    fy: float = 53.0
    cx: float = 33.7
    cy: float = 22.6

    def scaled(self, factor: float) -> Lens:
        """The same lens before a picture of another size."""
        f = factor
        return Lens(round(self.width * f), round(self.height * f), self.fx * f, self.fy * f, self.cx * f, self.cy * f)


@dataclass(frozen=True, eq=False)
class View:
    """A camera at ``eye`` (world metres), its axes as unit vectors, float64 [3] each."""

    eye: NDArray[np.float64]
    right: NDArray[np.float64]
    up: NDArray[np.float64]
    forward: NDArray[np.float64]


def views(count: int = 6) -> list[View]:
    """Cameras along a curve in front of the box, held upright, each with another heading and pitch."""
    made = []
    for i in range(count):
        eye = np.array([-0.6 + 0.25 * i, -1.6 + 0.3 * np.sin(i), 1.4 + 0.12 * (i % 6)])
        heading, pitch = np.radians(62.0 - 14.0 * i), np.radians(-12.0 - 3.0 * (i % 3))
        forward = np.array([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)])
        right = np.cross(forward, UP)
        right /= np.linalg.norm(right)
        made.append(View(eye, right, np.cross(right, forward), forward))
    return made


@dataclass(frozen=True, eq=False)
class Picture:
    """``colour`` uint8 [H, W, 3] RGB, planar ``depth`` and ``distance`` along the ray, float64 [H, W] metres."""

    colour: NDArray[np.uint8]
    depth: NDArray[np.float64]
    distance: NDArray[np.float64]


def look(view: View, lens: Lens) -> Picture:
    """Cast a ray through the centre of every pixel."""
    across = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fx
    down = (np.arange(lens.height) + 0.5 - lens.cy) / lens.fy
    rays = view.forward + across[None, :, None] * view.right - down[:, None, None] * view.up
    return cast(view, rays)


Bend = Callable[[NDArray[np.float64], NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Where a lens shows what a pinhole of focal length 1 shows at x and y."""


def look_bent(view: View, lens: Lens, bend: Bend) -> Picture:
    """The picture of a lens that bends: the inverse of its formula, found by iteration."""
    across = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fx
    bent = np.meshgrid(across, (np.arange(lens.height) + 0.5 - lens.cy) / lens.fy)
    x, y = bent
    for _ in range(100):
        u, v = bend(x, y)
        x, y = x + bent[0] - u, y + bent[1] - v
    return cast(view, view.forward + x[..., None] * view.right - y[..., None] * view.up)


def cast(view: View, rays: NDArray[np.float64]) -> Picture:
    """The picture along ``rays``, float64 [H, W, 3], whose length along ``forward`` is 1."""
    rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    depth, axis = box_hits(np.stack([LOW, HIGH]), view.eye, rays, leaving=True)
    face = 2 * axis + (np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0.0)
    near, axis = box_hits(np.stack([BOX_LOW, BOX_HIGH]), view.eye, rays, leaving=False)
    box_face = 2 * axis + (np.take_along_axis(rays, axis[..., None], -1)[..., 0] < 0.0)
    hit, depth = near < depth, np.minimum(near, depth)
    colour = np.where(hit[..., None], WALL_COLOURS[box_face] * 0.5, WALL_COLOURS[face]).astype(np.uint8)
    return Picture(colour, depth, depth * np.linalg.norm(rays, axis=-1))


def opencv_pose(view: View) -> NDArray[np.float64]:
    """Camera-to-world, float64 [4, 4], x right, y down, z forward."""
    return _matrix(view.right, -view.up, view.forward, view.eye)


def opengl_pose(view: View) -> NDArray[np.float64]:
    """Camera-to-world, float64 [4, 4], x right, y up, z backward."""
    return _matrix(view.right, view.up, -view.forward, view.eye)


def y_up(view: View) -> View:
    """The same view in a world whose y points up: x stays, z points towards where -y did."""
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return View(turn @ view.eye, turn @ view.right, turn @ view.up, turn @ view.forward)


def elsewhere(view: View) -> View:
    """The same view in a world that is turned and moved, as structure from motion leaves it."""
    a, b = 0.7, -1.1
    first = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    second = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(b), -np.sin(b)], [0.0, np.sin(b), np.cos(b)]])
    turn = second @ first
    return View(turn @ view.eye + np.array([0.4, -2.0, 0.3]), turn @ view.right, turn @ view.up, turn @ view.forward)


def quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """w, x, y, z of a rotation, float64 [3, 3]: the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(matrix)[1][:, -1]
    return np.array([w, x, y, z])


def check_on_room(
    scene: Scene, tolerance: float = 0.004, share: float = 0.99, colour_step: float = 0.0, colour_share: float = 0.97
) -> None:
    """Assert that all depth lies on the room's surfaces within ``tolerance`` metres, for at least ``share`` of the
    pixels with depth, and that pictures show those surfaces' colours (see ``check_colours``).

    The scene's world may be moved, and turned about z: where cameras stand settles how.
    """
    turn, shift = _about_z(scene)
    for frame, view in zip(scene.frames, _views_of(scene), strict=True):
        np.testing.assert_allclose(turn @ frame.camera.centre + shift, view.eye, atol=tolerance)
        depth = frame.depth(None)
        camera = frame.camera.resized(depth.shape[1], depth.shape[0])
        points = camera.unproject(depth)[depth > 0.0] @ turn.T + shift
        assert len(points) > 0.5 * depth.size, f"{frame.name} has depth on {len(points)} pixels only"
        away = distance_to_room(points)
        near = (away < tolerance).mean()
        assert near >= share, f"{frame.name}: {near:.1%} lie on the room, the median is {np.median(away):.4f} m away"
    check_colours(scene, colour_step, colour_share)


def check_colours(scene: Scene, colour_step: float = 0.0, share: float = 0.97) -> None:
    """Assert that ``share`` of each picture's pixels show the colours that the room has there, through the frame's
    camera, within ``colour_step``."""
    turn, shift = _about_z(scene)
    for frame in scene.frames:
        camera = frame.camera
        right, down, forward = (turn @ camera.camera_to_world[:3, :3]).T
        view = View(turn @ camera.centre + shift, right, -down, forward)
        lens = Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        expected = look(view, lens).colour.astype(int)
        shown = frame.read_colour(None).astype(int)
        assert shown.shape == expected.shape
        right = (np.abs(shown - expected).max(-1) <= colour_step).mean()
        assert right > share, f"{frame.name} shows the room's colours on {right:.1%} of its pixels"


def distance_to_room(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far points, float64 [N, 3], are from the nearest surface, in metres."""
    walls = np.abs(np.concatenate([points - LOW, points - HIGH], -1)).min(-1)
    outside = np.linalg.norm(np.maximum(0.0, np.maximum(BOX_LOW - points, points - BOX_HIGH)), axis=-1)
    inside = np.minimum(points - BOX_LOW, BOX_HIGH - points).min(-1)
    box = np.where(outside > 0.0, outside, np.abs(inside))
    return np.asarray(np.minimum(walls, box))


def _views_of(scene: Scene) -> list[View]:
    known = views(len(scene.frames))
    assert len(scene.frames) == len(known)
    return known


def _about_z(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The turn about z, float64 [3, 3], and the shift that take the scene's world to the room's, from the cameras'
    centres alone."""
    found = np.array([frame.camera.centre for frame in scene.frames])
    known = np.array([view.eye for view in _views_of(scene)])
    one, other = (found - found.mean(0))[:, :2], (known - known.mean(0))[:, :2]
    angle = np.angle(np.sum(np.conj(one[:, 0] + 1j * one[:, 1]) * (other[:, 0] + 1j * other[:, 1])))
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return turn, known.mean(0) - turn @ found.mean(0)


def _matrix(*columns: NDArray[np.float64]) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3] = np.stack(columns, axis=1)
    return pose


def write_colour(path: Path, rgb: NDArray[np.uint8]) -> None:
    """uint8 [H, W, 3] RGB as PNG or as JPEG of the best quality."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 100]):
        raise OSError(path)


def write_grey(path: Path, values: NDArray[np.generic]) -> None:
    """A PNG with one channel, as deep as ``values``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), values):
        raise OSError(path)


def in_steps(depth: NDArray[np.float64], steps_a_metre: float) -> NDArray[np.uint16]:
    """Depth in metres as 16-bit whole steps."""
    return np.round(depth * steps_a_metre).astype(np.uint16)


def write_pair(colour: Path, depth: Path, picture: Picture, steps_a_metre: float = 1000) -> None:
    """A picture's colour as an image, its planar depth as a PNG of 16 bits."""
    write_colour(colour, picture.colour)
    write_grey(depth, in_steps(picture.depth, steps_a_metre))
