"""The digest of the code changes with a source or a pin, and with nothing else."""

from __future__ import annotations

from pathlib import Path

from engine.machine.code_digest import code_digest


def test_digest_changes_only_with_sources_and_pins(tmp_path: Path) -> None:
    files = {
        "engine/lift.py": True,
        "engine/deep/new.py": True,
        "engine/table.csv": True,
        "engine/notes.txt": False,
        "docs/page.py": False,
        "requirements/constraints-3.11.txt": True,
        "requirements/hashes-3.11.txt": True,
        "requirements/test.txt": False,
    }
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1")
    digests = [code_digest("engine", root=tmp_path)]
    for name, changes in files.items():
        code_digest.cache_clear()
        (tmp_path / name).write_text("2")
        digests.append(code_digest("engine", root=tmp_path))
        assert (digests[-1] != digests[-2]) == changes, name
    assert all(len(each) == 8 for each in digests)
