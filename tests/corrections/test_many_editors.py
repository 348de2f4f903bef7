"""However editors of one lift meet, are killed or sleep, a successful edit stays. PLGS_EDITS edits are made amid
kills."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.corrections.two_rooms import write_result

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
EDITORS = Path(__file__).with_name("editors.py")
EDITS = os.environ.get("PLGS_EDITS", "40")


def editors(lift: Path, *attack: str) -> dict[str, list[str]]:
    """What `editors` tells of an attack."""
    command = [sys.executable, str(EDITORS), str(write_result(lift)), *attack]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert ended.returncode == 0, ended.stderr
    told: dict[str, list[str]] = json.loads(ended.stdout)
    return told


def test_no_edit_is_lost_when_four_editors_are_killed_and_clocks_go_back(tmp_path: Path) -> None:
    told = editors(tmp_path / "lift", "kills", EDITS)
    assert len(told["answered"]) >= int(EDITS) and not told["lost"], told["lost"]


def test_no_edit_is_lost_when_an_editor_pauses_at_any_system_call(tmp_path: Path) -> None:
    told = editors(tmp_path / "lift", "sleeps")
    assert len(told["slept"]) > 10 and not told["lost"], told["lost"]
