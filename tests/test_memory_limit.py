"""Memory runs out while a file is read: each reader says so in a line. What claims too much is refused before."""

import json
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import OpenEXR
import pytest
import torch
from safetensors.torch import save_file

from engine import gates
from engine.job.system import main_memory
from engine.model.checking import read_tensors
from engine.passes.exr import LAYER, read_exr
from engine.posed.ply import read_gaussians
from tests.raises_key import raises_key

READ = """
import json, resource, sys
from pathlib import Path
import torch
import cv2
from engine.errors import PlgsError
from engine.json_file import read_value
from engine.job.events import last_events
from engine.posed.array_file import read_npz, read_npy
from engine.json_file import read_json_object
from engine.scene.formats.record3d import _read_exr
from engine.scene.pixels import decode, read_indices
from engine.model.checking import read_tensors
from engine.passes.exr import read_exr, read_note

cv2.setNumThreads(1)
folder = Path(sys.argv[1])
readers = {
    "npz": lambda: read_npz(folder / "a.npz", "Fix."),
    "npy": lambda: read_npy(folder / "a.npy", "Fix."),
    "json": lambda: read_json_object(folder / "a.json"),
    "job's json": lambda: read_value(folder / "a.json", "Fix."),
    "png": lambda: decode(folder / "a.png", as_colour=True),
    "mask": lambda: read_indices(folder / "mask.png"),
    "jpeg": lambda: decode(folder / "a.jpg", as_colour=True),
    "events": lambda: last_events(folder / "events.jsonl"),
    "exr": lambda: _read_exr(folder / "a.exr"),
    "safetensors": lambda: read_tensors(folder / "a.safetensors"),
    "passes": lambda: read_exr(folder / "passes.exr"),
    "note": lambda: read_note(folder / "passes.exr", "note"),
}
for read in readers.values():
    read()
told = {}
for name, read in readers.items():
    for megabytes in (0, 1, 4, 16, 64, 4096):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * 4096 + (megabytes << 20), -1))
        try:
            read()
            told.setdefault(name, []).append("read")
        except ValueError if name in ("safetensors", "passes", "note") else PlgsError as error:
            assert "\\n" not in str(error)
            told.setdefault(name, []).append("refused")
        except Exception as error:
            told.setdefault(name, []).append(repr(error))
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (-1, -1))
print(json.dumps(told))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does it")
def test_every_file_reader_reports_a_lack_of_memory(root: Path, tmp_path: Path) -> None:
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
    save_file({"a": torch.ones(3_000_000), "b": torch.ones(3_000_000)}, tmp_path / "a.safetensors")
    layers = [f"Combined.{c}" for c in "RGBA"]
    layers += [f"{name}.V" for name in ("Depth", "Semantic", "Instance", "Confidence", "Entropy")]
    with OpenEXR.File({}, {f"{LAYER}.{name}": np.zeros((800, 1000), np.float32) for name in layers}) as file:
        file.write(str(tmp_path / "passes.exr"))
    command = [sys.executable, "-c", READ, tmp_path]
    said = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=300)
    assert said.returncode == 0, said.stderr
    told: dict[str, list[str]] = json.loads(said.stdout.splitlines()[-1])
    assert all(answers[-1] == "read" for answers in told.values()), told
    assert all(answer in ("read", "refused") for answers in told.values() for answer in answers), told
    refused = {name for name, answers in told.items() if "refused" in answers}  # there was too little indeed
    assert {"safetensors", "passes"} <= refused and len(refused) >= 8


def test_a_sparse_model_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    """Its header is right, its disk blocks are few."""
    memory = main_memory()
    size = memory.total + (1 << 30)
    path = tmp_path / "a.safetensors"
    header = f'{{"a": {{"dtype": "U8", "shape": [{size}], "data_offsets": [0, {size}]}}}}'.encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    with path.open("ab") as file:
        file.truncate(8 + len(header) + size)
    with pytest.raises(ValueError, match="more than there is"):
        read_tensors(path)


def test_passes_too_large_for_memory_are_refused_before_reading(tmp_path: Path) -> None:
    """20 kB that would take gigabytes: fewer pixels than a picture may have, but many channels of them."""
    zeros = np.zeros((8, 8), np.float32)
    with OpenEXR.File({}, {f"{LAYER}.{number}": zeros for number in range(400)}) as file:
        file.write(str(tmp_path / "a.exr"))
    data = bytearray((tmp_path / "a.exr").read_bytes())
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        place = data.index(name) + len(name) + 4
        data[place : place + 16] = np.array([0, 0, 9999, 9999], "<i4").tobytes()
    (tmp_path / "a.exr").write_bytes(data)
    with pytest.raises(ValueError, match="channels are too many"):
        read_exr(tmp_path / "a.exr")


def test_a_memory_error_while_reading_advises_no_new_lift(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gaussians.ply").write_bytes(b"ply")
    monkeypatch.setattr(gates, "open_plain", Mock(side_effect=MemoryError))
    with raises_key("unreadable memory") as raised:
        read_gaussians(tmp_path / "gaussians.ply")
    assert "again" not in str(raised.value)
