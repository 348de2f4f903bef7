"""Blender's decoder gives the very numbers that OpenCV gives."""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import cv2
import numpy as np
import pytest
from plgs.engine.errors import PlgsError
from plgs.engine.scene import open_scene
from plgs.engine.scene.pixels import decode
from plgs.plgs_blender.frame_pictures import decode_in_blender, read_here
from tiny_scene import write_tiny_scene


@pytest.mark.parametrize(
    ("shape", "kind"), [((7, 5), np.uint16), ((7, 5), np.uint8), ((7, 5, 3), np.uint8), ((7, 5, 4), np.uint8)]
)
def test_pngs_of_every_kind(tmp_path: Path, shape: tuple[int, ...], kind: type) -> None:
    values = np.random.default_rng(0).integers(0, np.iinfo(kind).max + 1, shape).astype(kind)
    cv2.imwrite(str(tmp_path / "a.png"), values)
    np.testing.assert_array_equal(decode_in_blender(tmp_path / "a.png", False), decode(tmp_path / "a.png", False))
    assert len(bpy.data.images) == 0


def test_colour_of_a_jpeg(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.jpg"), np.full((16, 16, 3), (20, 90, 200), np.uint8))
    assert np.abs(decode_in_blender(tmp_path / "a.jpg", True).astype(int) - [200, 90, 20]).max() <= 3


def test_a_scenes_depth_and_masks_without_opencv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = open_scene(write_tiny_scene(tmp_path / "room", frames=1)).frames[0]
    depth, mask = frame.depth(), frame.mask()
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert frame.read_depth is not None and frame.read_mask is not None
    np.testing.assert_array_equal(read_here(frame.read_depth), depth)
    read = read_here(frame.read_mask)
    assert read is not None and read.segments == mask.segments
    np.testing.assert_array_equal(read.ids, mask.ids)


def test_what_needs_opencv_is_left_to_an_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)

    def straighten(size: object) -> np.ndarray:
        import cv2

        return cv2.remap(np.zeros((2, 2)), None, None, 0)

    assert read_here(straighten) is None


def test_damage_is_told(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((9, 9), np.uint16))
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[-20] ^= 1
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(PlgsError, match="damaged"):
        read_here(lambda size: decode(tmp_path / "a.png", as_colour=False))
