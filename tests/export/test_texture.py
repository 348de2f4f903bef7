"""The pictures of a surface: sharp where a photo shows it, and the vertices' colours where none does."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.export.fusion import SmallView, Surface
from engine.export.mesh import sharpened
from engine.export.texture import Texture, jpeg_bytes, textured
from engine.scene import Camera, Frame

WALL, OTHER, STEPS, FAR = 7 << 16, 8 << 16, 21, 2.0
GAINS = (1.0, 0.7, 1.25)


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colours of the wall at places in metres, with a period of 0.2 m: finer than its vertices."""
    wave = np.sin(2 * np.pi * x / 0.2) * np.sin(2 * np.pi * y / 0.2)
    return np.stack([120 + 60 * wave, 110 + 10 * x, 100 - 50 * wave], axis=-1)


def wall() -> tuple[Surface, np.ndarray]:
    """A 2 by 2 m wall at FAR metres in the pattern's mean colour; its right half has another label."""
    x, y = (each.ravel() for each in np.meshgrid(*[np.linspace(-1, 1, STEPS)] * 2))
    xyz = np.stack([x, y, np.full_like(x, FAR)], axis=1).astype(np.float32)
    first = (np.arange(STEPS - 1)[:, None] * STEPS + np.arange(STEPS - 1)).ravel()
    corners = ((0, STEPS, 1), (1, STEPS, STEPS + 1))
    triangles = np.concatenate([first[:, None] + corner for corner in corners])
    rgb = np.tile(np.array([120, 110, 100], np.uint8), (len(xyz), 1))
    return Surface(xyz, rgb, np.tile(np.float32([0, 0, -1]), (len(xyz), 1)), triangles), np.where(x > 0.5, OTHER, WALL)


def view(number: int, shift: float) -> SmallView:
    """A photo of 400 pixels from a shifted camera, with a smaller view. A board hides the left fifth of the second
    one."""
    pose = np.eye(4)
    pose[0, 3] = shift
    camera = Camera(400, 400, 360.0, 360.0, 200.0, 200.0, pose)
    x = (np.arange(400) + 0.5 - 200) / 360 * FAR
    photo = pattern(*np.meshgrid(x + shift, x)) * GAINS[number]
    depth = np.full((100, 100), FAR, np.float32)
    if number == 1:
        photo[:, :80], depth[:, :20] = (255, 0, 0), 1.0
    picture = np.rint(photo).clip(0, 255).astype(np.uint8)
    frame = Frame(str(number), camera, False, Path(f"{number}.jpg"), None, lambda size: picture, None, None)
    label = np.full(depth.shape, WALL)
    return SmallView(camera.resized(100, 100), depth, cv2.resize(picture, (100, 100)), label, frame)


def drawn(surface: Surface, label: np.ndarray, texture: Texture) -> tuple[np.ndarray, np.ndarray]:
    """Places [N, 2] in the middle of the triangles and the colours that the pictures have there, [N, 3]."""
    xy, uv = surface.xyz[surface.triangles].mean(axis=1)[:, :2], texture.uv.mean(axis=1)
    colours = np.empty((len(xy), 3))
    for value, picture in texture.pictures.items():
        rows = np.flatnonzero((label[surface.triangles] == value).sum(axis=1) > 1)
        at = (uv[rows] * picture.shape[1::-1] - 0.5).astype(np.float32)
        colours[rows] = cv2.remap(picture, at[:, None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
    return xy, colours


def test_mesh_textures_show_photo_pixels_at_one_exposure() -> None:
    surface, label = wall()
    texture = textured(surface, label, [view(0, 0.0), view(1, -0.8), view(2, 0.8)])
    assert texture.pictures.keys() == {WALL, OTHER} and 0 <= texture.uv.min() <= texture.uv.max() <= 1
    xy, colours = drawn(surface, label, texture)
    truth = pattern(xy[:, 0], xy[:, 1])
    assert np.abs(colours - truth).mean() < 6 < 0.3 * np.abs(surface.rgb[0] - truth).mean()  # of one vertex colour
    assert np.percentile(np.abs(colours - truth), 99) < 25  # also beside the board, and at seams
    again = textured(surface, label, [view(0, 0.0), view(1, -0.8), view(2, 0.8)])
    assert all((again.pictures[each] == texture.pictures[each]).all() for each in again.pictures)
    assert (again.uv == texture.uv).all()


def test_mesh_triangles_that_no_photo_sees_take_vertex_colours() -> None:
    surface, label = wall()
    texture = textured(surface, label, [view(1, 0.6)])  # which does not see the left
    xy, colours = drawn(surface, label, texture)
    unseen = xy[:, 0] < -0.6
    assert unseen.any() and np.abs(colours[unseen] - surface.rgb[0]).max() <= 1
    assert np.abs(colours[xy[:, 0] > 0] - surface.rgb[0]).mean() > 10


def test_large_photos_are_shrunk_for_mesh_textures(monkeypatch: pytest.MonkeyPatch) -> None:
    surface, label = wall()
    monkeypatch.setattr("engine.export.texture.LARGEST", 100)
    texture = textured(surface, label, [view(0, 0.0)])
    assert sum(picture.shape[0] * picture.shape[1] for picture in texture.pictures.values()) <= 100**2
    xy, colours = drawn(surface, label, texture)
    assert np.corrcoef(colours[:, 0], pattern(xy[:, 0], xy[:, 1])[:, 0])[0, 1] > 0.8
    assert jpeg_bytes(texture.pictures[WALL])[:2] == b"\xff\xd8"


def test_sharpened_depth_has_its_edges_where_depth_was_measured() -> None:
    rendered = np.repeat(np.float32([[1, 1, 1, 1.6, 2.4, 3, 3, 3]]), 8, axis=0)  # a mixture in the middle
    measured = np.repeat(np.float32([[1, 1, 1, 1, 3, 3, 0, 9]]), 8, axis=0)  # none, and one that is wrong
    np.testing.assert_array_equal(sharpened(rendered, measured)[0], np.float32([1, 1, 1, 1, 3, 3, 3, 3]))
