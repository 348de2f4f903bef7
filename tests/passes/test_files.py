"""The columns of PLY files, previews and contact sheets."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.model.baking import BakedGaussians
from engine.passes.layers import decide
from engine.passes.ply import write_splats
from engine.passes.previews import SheetRow, write_contact_sheet, write_previews
from tests.passes.views import CLASSES, made_rendering

RANDOM = np.random.default_rng(5)
COUNT = 50


def _splats() -> BakedGaussians:
    quats = RANDOM.normal(size=(COUNT, 4)).astype(np.float32)
    return BakedGaussians(
        means=RANDOM.normal(size=(COUNT, 3)).astype(np.float32),
        scales=RANDOM.uniform(0.001, 0.2, (COUNT, 3)).astype(np.float32),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        opacities=RANDOM.uniform(0.01, 0.99, COUNT).astype(np.float32),
        colours=RANDOM.uniform(0, 1, (COUNT, 3)).astype(np.float32),
        class_id=RANDOM.integers(0, 22, COUNT).astype(np.int32),
        instance_id=RANDOM.integers(0, 99, COUNT).astype(np.int32),
    )


def test_ply_has_the_columns_of_splat_viewers(tmp_path: Path) -> None:
    write_splats(tmp_path / "a.ply", _splats())
    head = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert [line for line in head if line.startswith("property") and " float " not in line] == []
    names = [line.split()[-1] for line in head if line.startswith("property float")]
    assert names[:6] == ["x", "y", "z", "nx", "ny", "nz"]
    assert names[6:-5] == [*(f"f_dc_{k}" for k in range(3)), "opacity"] + [
        *(f"scale_{k}" for k in range(3)),
        *(f"rot_{k}" for k in range(4)),
    ]
    assert names[-5:] == ["class_id", "instance_id", "red", "green", "blue"]


def test_preview_pictures_of_a_frame_are_written(tmp_path: Path) -> None:
    layers = decide(made_rendering(), CLASSES)
    paths = write_previews(tmp_path, "0001", layers, CLASSES, {3: (1, 2, 3)})
    assert [path.name for path in paths] == ["0001_colour.png", "0001_semantic.png", "0001_instance.png"]
    colour, semantic, instance = (cv2.imread(str(path))[..., ::-1] for path in paths)
    assert colour[0, 0].tolist() == pytest.approx([128, 64, 255], abs=1)  # as rendered, not linear
    assert semantic[0, 3].tolist() == [120, 130, 140]
    assert semantic[0, 7].tolist() == [0, 0, 0]
    assert instance[0, 0].tolist() == [1, 2, 3]
    assert instance[0, 3].tolist() == [52, 54, 58]


def test_the_contact_sheet_has_a_row_for_each_frame(tmp_path: Path) -> None:
    layers = decide(made_rendering(), CLASSES)
    photo = np.full((6, 8, 3), 200, np.uint8)
    row = SheetRow("0001", photo, layers.semantic, layers)
    write_contact_sheet(tmp_path / "a.png", [row], CLASSES)
    write_contact_sheet(tmp_path / "b.png", [row, SheetRow("ä", photo, layers.semantic, layers)], CLASSES)
    one, two = (cv2.imread(str(tmp_path / f"{name}.png")) for name in "ab")
    assert two.shape[1] == one.shape[1]
    assert two.shape[0] - one.shape[0] == 246
    with pytest.raises(ValueError, match="at least one"):
        write_contact_sheet(tmp_path / "c.png", [], CLASSES)
