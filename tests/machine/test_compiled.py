"""Digests of the code, and the names of compiled kernels, change with all that goes into them."""

import runpy
from pathlib import Path

import pytest

from engine.machine import compiled
from engine.machine.code_digest import code_digest


def test_changing_any_kernel_source_gives_a_new_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = {
        "machine/compiled.py": "",
        "machine/vectors.py": "from .compiled import machine_target",
        "raster/kernel.py": "from ..machine.compiled import compiled",
        "model/deep/kernel.py": "from ...machine.compiled import Array, compiled",
        "model/deep/constants.py": "WIDTH = 16",
        "scene/camera.py": "",
        "lift/run.py": "from ..machine.log_compilation import log_compilation",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(compiled, "__file__", str(tmp_path / "machine" / "compiled.py"))
    names = [compiled._version()]
    assert compiled._version() == names[0]
    with_kernels = ("machine/vectors.py", "raster/kernel.py", "model/deep/kernel.py", "model/deep/constants.py")
    for name in with_kernels:
        (tmp_path / name).write_text(texts[name] + " # changed")
        names.append(compiled._version())
    assert len(set(names)) == 1 + len(with_kernels)
    for name in ("scene/camera.py", "lift/run.py"):
        (tmp_path / name).write_text(texts[name] + " # changed")
    assert compiled._version() == names[-1]


def twice(value: object) -> object:
    return value + value  # type: ignore[operator]


def test_two_processes_compile_one_kernel_without_mix_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One compiles the kernel for floats, the other for integers: neither sees what the other is about to list."""
    monkeypatch.setattr(compiled, "CACHE_FOLDER", tmp_path)
    ours, theirs, later = (compiled.compiled(twice)._cache._cache_file for _ in range(3))
    save = ours._save_data

    def save_late(name: str, content: bytes) -> None:
        monkeypatch.setattr(theirs, "_load_index", dict)
        theirs.save("integers", b"for integers")
        save(name, content)

    monkeypatch.setattr(ours, "_save_data", save_late)
    ours.save("floats", b"for floats")
    assert later.load("integers") == b"for integers" and later.load("floats") in (None, b"for floats")


def test_a_clone_and_an_installed_extension_share_compiled_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "CACHE_FOLDER", tmp_path / "cache")
    found = []
    for place in ("clone", "extension"):
        source = tmp_path / place / "raster" / "kernel.py"
        source.parent.mkdir(parents=True)
        source.write_text("def twice(value):\n    return value + value\n")
        kernel = compiled.compiled(runpy.run_path(str(source), run_name="engine.raster.kernel")["twice"])
        found.append((kernel(21), kernel.stats.cache_hits.total()))
    assert found == [(42, 0), (42, 1)]


def test_the_code_digest_changes_only_with_sources_or_pins(tmp_path: Path) -> None:
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
