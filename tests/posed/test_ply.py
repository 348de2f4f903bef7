"""Files of splats that are read in part, or refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from engine.passes.ply import columns_of, write_ply_table
from engine.posed.ply import read_gaussians
from tests.raises_key import raises_key

COUNT = 6


@pytest.fixture
def original(tmp_path: Path) -> bytes:
    random = np.random.default_rng(0).normal(size=(COUNT, 14)).astype(np.float32)
    columns = columns_of("x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3", random)
    write_ply_table(tmp_path / "splats.ply", {**columns, "class_id": np.arange(COUNT, dtype=np.int32)})
    return (tmp_path / "splats.ply").read_bytes()


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e30])
def test_splats_with_impossible_positions_are_left_out(original: bytes, tmp_path: Path, value: float) -> None:
    path = tmp_path / "nowhere.ply"
    start = original.index(b"end_header\n") + len(b"end_header\n")
    path.write_bytes(original[:start] + np.float32(value).tobytes() + original[start + 4 :])
    assert read_gaussians(path)["class_id"].tolist() == [1, 2, 3, 4, 5]


def test_a_column_that_appears_twice(original: bytes, tmp_path: Path) -> None:
    path = tmp_path / "twice.ply"
    path.write_bytes(original.replace(b"property float y", b"property float x"))
    with raises_key("no-splats"):
        read_gaussians(path)


def test_splats_of_holes(tmp_path: Path) -> None:
    path = tmp_path / "holes.ply"
    with path.open("wb") as file:
        file.truncate(5 << 30)
    with raises_key("unreadable"):
        read_gaussians(path)
