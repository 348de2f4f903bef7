"""Memory runs out while a result is read: each reader says so in a line."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from safetensors.torch import save_file

from engine.job.system import main_memory
from engine.model.tensor_file import read_tensors
from engine.passes.exr import LAYER, read_exr
from tests.limited_memory import check_told, told_by

READ = """
import torch
from engine.model.tensor_file import read_tensors
from engine.passes.exr import read_exr, read_note

refusals = (ValueError,)
readers = {
    "safetensors": lambda: read_tensors(folder / "a.safetensors"),
    "passes": lambda: read_exr(folder / "a.exr"),
    "note": lambda: read_note(folder / "a.exr", "note"),
}
"""
CHANNELS = [f"Combined.{c}" for c in "RGBA"]
CHANNELS += [f"{name}.V" for name in ("Depth", "Semantic", "Instance", "Confidence", "Entropy")]


def write_passes(path: Path, width: int, height: int) -> bytes:
    zeros = np.zeros((height, width), np.float32)
    with OpenEXR.File({}, {f"{LAYER}.{name}": zeros for name in CHANNELS}) as file:
        file.write(str(path))
    return path.read_bytes()


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does it")
def test_each_reader_reports_it(root: Path, tmp_path: Path) -> None:
    save_file({"a": torch.ones(3_000_000), "b": torch.ones(3_000_000)}, tmp_path / "a.safetensors")
    write_passes(tmp_path / "a.exr", 1000, 800)
    told = told_by(READ, root, tmp_path)
    check_told(told)
    assert "refused" in told["safetensors"] and "refused" in told["passes"]  # there was too little indeed


def test_a_model_that_is_mostly_a_hole_is_refused_before_it_is_read(tmp_path: Path) -> None:
    """Its header is right, its disk blocks are few."""
    memory = main_memory()
    assert memory is not None
    size = memory.total + (1 << 30)
    path = tmp_path / "a.safetensors"
    header = f'{{"a": {{"dtype": "U8", "shape": [{size}], "data_offsets": [0, {size}]}}}}'.encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    with path.open("ab") as file:
        file.truncate(8 + len(header) + size)
    with pytest.raises(ValueError, match="more than there is"):
        read_tensors(path)


def test_passes_that_claim_more_than_memory_holds_are_refused_before_they_are_read(tmp_path: Path) -> None:
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
