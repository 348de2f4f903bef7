"""How much memory there is: of the machine, or of the container."""

from __future__ import annotations

from pathlib import Path

import pytest

from engine.job.system import SHARE, MainMemory, main_memory

INFO = "MemTotal:       1000 kB\nMemFree:         100 kB\nMemAvailable:    600 kB\nHugePages_Total:   0\n"


@pytest.fixture
def proc(tmp_path: Path) -> Path:
    path = tmp_path / "meminfo"
    path.write_text(INFO)
    return path


def limit(folder: Path, most: str, held: int) -> Path:
    (folder / "memory.max").write_text(most)
    (folder / "memory.current").write_text(str(held))
    return folder


def test_the_memory_of_the_machine(proc: Path, tmp_path: Path) -> None:
    assert main_memory(proc, tmp_path) == MainMemory(1_024_000, 614_400)
    assert main_memory(proc, limit(tmp_path, "max\n", 5)) == MainMemory(1_024_000, 614_400)


def test_the_memory_limit_of_a_container(proc: Path, tmp_path: Path) -> None:
    assert main_memory(proc, limit(tmp_path, "500000\n", 100_000)) == MainMemory(500_000, 400_000)
    assert main_memory(proc, limit(tmp_path, "500000", 900_000)) == MainMemory(500_000, 0)
    assert main_memory(proc, limit(tmp_path, "900000000", 0)) == MainMemory(1_024_000, 614_400)


def test_a_part_of_the_memory(proc: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SHARE, "0.0005")
    assert main_memory(proc, tmp_path) == MainMemory(500_000, 500_000)
    monkeypatch.setenv(SHARE, "5")
    assert main_memory(proc, tmp_path) == MainMemory(1_024_000, 614_400)


@pytest.mark.parametrize("text", ["", "MemTotal: 5 kB", "MemTotal: x\n", "MemTotal:\nMemAvailable:\n"])
def test_what_cannot_be_read_is_unknown(proc: Path, tmp_path: Path, text: str) -> None:
    proc.write_text(text)
    assert main_memory(proc, tmp_path) is None


def test_of_this_machine() -> None:
    memory = main_memory()
    assert memory is None or memory.total >= memory.free > 0
