"""Frames read at the size of the lift."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import load_view, open_scene, size_within
from engine.scene.borders import SEAM
from tests.tiny_scene import write_tiny_scene

SIZE, HALF = (320, 240), (160, 120)
THICK = 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frame 0001 has the black borders that an undistortion leaves at the upper and the lower side."""
    folder = write_tiny_scene(tmp_path_factory.mktemp("scene"), frames=2, size=SIZE)
    path = folder / "color" / "0001.png"
    picture = cv2.imread(str(path))
    assert picture is not None
    picture = np.maximum(picture, 60)
    picture[:THICK] = 0
    picture[-THICK:] = 0
    cv2.imwrite(str(path), picture)
    return folder


def test_everything_is_brought_to_one_size(folder: Path) -> None:
    view = load_view(open_scene(folder).frames[0], HALF)
    assert (view.camera.width, view.camera.height) == HALF
    shape = HALF[::-1]
    assert view.colour.shape == (*shape, 3) and view.depth.shape == view.mask.ids.shape == shape
    assert view.border is None


@pytest.mark.parametrize("size", [None, HALF])
def test_black_borders_are_found_at_any_size(folder: Path, size: tuple[int, int] | None) -> None:
    border = load_view(open_scene(folder).frames[1], size).border
    width, height = size or SIZE
    thick = THICK * width // SIZE[0]
    assert border is not None and border.shape == (height, width)
    assert border[:thick].all() and border[-thick:].all()
    assert not border[thick + SEAM : -thick - SEAM].any()


def test_sizes_keep_their_aspect_and_never_grow() -> None:
    assert size_within((640, 480), (320, 320)) == (320, 240)
    assert size_within((480, 640), (320, 320)) == (240, 320)
    assert size_within((100, 50), (320, 320)) == (100, 50)
    assert size_within((5000, 3), (100, 100)) == (100, 1)
