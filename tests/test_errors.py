"""What an error says to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from engine import gates
from engine.errors import PlgsError
from engine.posed.ply import read_gaussians


def test_what_ran_out_of_memory_is_not_lifted_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_memory(path: Path) -> object:
        raise MemoryError

    (tmp_path / "gaussians.ply").write_bytes(b"ply")
    monkeypatch.setattr(gates, "open_plain", no_memory)
    with pytest.raises(PlgsError, match=r"no memory is left .*\. Close other programs") as raised:
        read_gaussians(tmp_path / "gaussians.ply")
    assert "again" not in str(raised.value)
