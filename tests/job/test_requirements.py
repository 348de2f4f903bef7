"""What the engine needs, read from the requirement files, for every system and Python."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from engine.errors import PlgsError
from engine.job.environment import constraints_path, digest, module_of, needed_packages, pinned_versions


def test_everything_that_a_lift_imports_is_pinned(root: Path) -> None:
    assert pinned_versions(root) == ((3, 11), (3, 13))
    for version in pinned_versions(root):
        needed = needed_packages(root, version)
        assert next(iter(needed)) == "torch" and all(needed.values())
        assert {module_of(name) for name in needed} == {
            "torch", "open3d", "cv2", "OpenEXR", "numba", "scipy", "safetensors", "lz4", "numpy",
        }  # fmt: skip
    assert needed_packages(root, (3, 11))["scipy"] != needed_packages(root, (3, 13))["scipy"]
    assert needed_packages(root, (3, 12))["numpy"] is None


@pytest.mark.parametrize("platform", ["linux", "win32", "darwin"])
def test_every_system_needs_the_same(root: Path, platform: str) -> None:
    modules = {module_of(name): pin for name, pin in needed_packages(root, (3, 11), platform).items()}
    assert modules == {module_of(name): pin for name, pin in needed_packages(root, (3, 11)).items()}


def test_a_different_text_means_a_different_environment(root: Path, tmp_path: Path) -> None:
    shutil.copytree(root / "requirements", tmp_path / "requirements")
    before = digest(tmp_path, (3, 11))
    assert before == digest(root, (3, 11)) != digest(root, (3, 13))
    with constraints_path(tmp_path, (3, 11)).open("a") as file:
        file.write("one-more==1.0\n")
    assert digest(tmp_path, (3, 11)) != before


def test_what_cannot_be_read_is_reported(root: Path, tmp_path: Path) -> None:
    with pytest.raises(PlgsError, match="torch.txt"):
        needed_packages(tmp_path, (3, 11))
    shutil.copytree(root / "requirements", tmp_path / "requirements")
    (tmp_path / "requirements" / "torch.txt").write_text('torch==1.0; os_name == "nt"\n')
    with pytest.raises(PlgsError, match="os_name"):
        needed_packages(tmp_path, (3, 11))
