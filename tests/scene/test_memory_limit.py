"""Memory runs out while a file is read: each reader says so in a line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does it")
READ = """
import json, resource, sys
from pathlib import Path
import cv2, numpy
from engine.job import EventReader, JobError
from engine.job.json_file import read_value
from engine.job.events import last_events
from engine.scene import SceneError
from engine.scene.array_file import read_npz, read_npy
from engine.scene.json_file import read_json_object
from engine.scene.matrices import read_matrix
from engine.scene.pixels import decode, decode_single_channel

cv2.setNumThreads(1)
folder = Path(sys.argv[1])
readers = {
    "npz": lambda: read_npz(folder / "a.npz", "Fix."),
    "npy": lambda: read_npy(folder / "a.npy", "Fix."),
    "json": lambda: read_json_object(folder / "a.json"),
    "job's json": lambda: read_value(folder / "a.json", "Fix."),
    "png": lambda: decode(folder / "a.png", as_colour=True),
    "mask": lambda: decode_single_channel(folder / "mask.png"),
    "jpeg": lambda: decode(folder / "a.jpg", as_colour=True),
    "events": lambda: last_events(folder / "events.jsonl"),
}
for name, read in readers.items():
    read()
told = {}
for name, read in readers.items():
    for megabytes in (0, 1, 4, 16, 64, 4096):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * 4096 + (megabytes << 20), -1))
        try:
            read()
            told.setdefault(name, []).append("read")
        except (SceneError, JobError) as error:
            assert "\\n" not in str(error)
            told.setdefault(name, []).append("refused")
        except (MemoryError, OSError) as error:
            told.setdefault(name, []).append(repr(error))
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (-1, -1))
print(json.dumps(told))
"""


def test_each_reader_says_so(root: Path, tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 255, (1500, 2000, 3), np.uint8)
    np.savez_compressed(tmp_path / "a.npz", xyz=np.zeros((2_000_000, 3)))
    np.save(tmp_path / "a.npy", np.zeros((2_000_000, 3)))
    (tmp_path / "a.json").write_text(json.dumps({"a": [{"b": number} for number in range(200_000)]}))
    cv2.imwrite(str(tmp_path / "a.png"), values)
    cv2.imwrite(str(tmp_path / "mask.png"), values[..., 0])
    cv2.imwrite(str(tmp_path / "a.jpg"), values)
    (tmp_path / "events.jsonl").write_text('{"seq": 1, "time": 0, "event": "warning", "message": "x"}\\n' * 100_000)
    said = subprocess.run([sys.executable, "-c", READ, tmp_path], cwd=root, capture_output=True, text=True, timeout=120)
    assert said.returncode == 0, said.stderr
    told = json.loads(said.stdout)
    assert all(answers[-1] == "read" for answers in told.values())
    assert all(answer in ("read", "refused") for name, answers in told.items() for answer in answers), told
    assert sum("refused" in answers for answers in told.values()) >= 5  # there was too little indeed
