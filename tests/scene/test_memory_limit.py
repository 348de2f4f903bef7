"""Memory runs out while a file is read: each reader says so in a line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from tests.limited_memory import check_told, told_by

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does it")
READ = """
import cv2
from engine.errors import PlgsError
from engine.json_file import read_value
from engine.job.events import last_events
from engine.posed.array_file import read_npz, read_npy
from engine.json_file import read_json_object
from engine.scene.formats.record3d import _read_exr
from engine.scene.pixels import decode, decode_single_channel

cv2.setNumThreads(1)
refusals = PlgsError
readers = {
    "npz": lambda: read_npz(folder / "a.npz", "Fix."),
    "npy": lambda: read_npy(folder / "a.npy", "Fix."),
    "json": lambda: read_json_object(folder / "a.json"),
    "job's json": lambda: read_value(folder / "a.json", "Fix."),
    "png": lambda: decode(folder / "a.png", as_colour=True),
    "mask": lambda: decode_single_channel(folder / "mask.png"),
    "jpeg": lambda: decode(folder / "a.jpg", as_colour=True),
    "events": lambda: last_events(folder / "events.jsonl"),
    "exr": lambda: _read_exr(folder / "a.exr"),
}
"""


def test_each_reader_reports_it(root: Path, tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 255, (1500, 2000, 3), np.uint8)
    np.savez_compressed(tmp_path / "a.npz", xyz=np.zeros((2_000_000, 3)))
    np.save(tmp_path / "a.npy", np.zeros((2_000_000, 3)))
    (tmp_path / "a.json").write_text(json.dumps({"a": [{"b": number} for number in range(200_000)]}))
    cv2.imwrite(str(tmp_path / "a.png"), values)
    cv2.imwrite(str(tmp_path / "mask.png"), values[..., 0])
    cv2.imwrite(str(tmp_path / "a.jpg"), values)
    (tmp_path / "events.jsonl").write_text('{"seq": 1, "time": 0, "event": "warning", "message": "x"}\\n' * 100_000)
    with OpenEXR.File({}, {"A": np.ones((1500, 2000), np.float32), "R": np.ones((1500, 2000), np.float32)}) as file:
        file.write(str(tmp_path / "a.exr"))
    told = told_by(READ, root, tmp_path)
    check_told(told)
    assert sum("refused" in answers for answers in told.values()) >= 6  # there was too little indeed
