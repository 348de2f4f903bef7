"""Compiled kernels, whose index is a pickle, are kept only where nobody else can write."""

import os
import sys
from pathlib import Path

import pytest

import engine.machine.compiled as compiled_kernels
from engine.machine.compiled import choose_cache_folder, why_unsafe

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="rights are kept otherwise there")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache folder."""
    tmp_path.chmod(0o700)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(compiled_kernels, "user_cache_folder", lambda: tmp_path / "home" / ".cache")
    return tmp_path / "home" / ".cache"


def test_a_new_cache_folder_is_private_to_the_user(cache: Path) -> None:
    before = os.umask(0)
    try:
        folder = choose_cache_folder("kernels")
    finally:
        os.umask(before)
    assert folder == cache / "plgs" / "kernels" and why_unsafe(folder) is None
    assert all(each.stat().st_mode & 0o77 == 0 for each in (folder, folder.parent, cache))


@pytest.mark.parametrize("unsafe", ["kernels", "plgs", ".cache", "home"])
def test_a_shared_cache_folder_is_not_used(cache: Path, unsafe: str, caplog: pytest.LogCaptureFixture) -> None:
    folder = choose_cache_folder("kernels")
    next(each for each in (folder, *folder.parents) if each.name == unsafe).chmod(0o777)
    own = choose_cache_folder("kernels")
    assert own != folder and why_unsafe(own) is None and own.stat().st_mode & 0o77 == 0
    assert "others may write" in caplog.text


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives folders away")
@pytest.mark.parametrize("unsafe", ["kernels", "plgs", ".cache"])
def test_a_cache_folder_of_another_user_is_not_used(cache: Path, unsafe: str) -> None:
    folder = choose_cache_folder("kernels")
    os.chown(next(each for each in (folder, *folder.parents) if each.name == unsafe), 12345, 12345)
    assert choose_cache_folder("kernels") != folder


def test_a_link_to_an_unsafe_cache_folder_is_not_used(cache: Path, tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    theirs.chmod(0o777)
    (cache / "plgs").mkdir(parents=True)
    (cache / "plgs" / "kernels").symlink_to(theirs)
    assert choose_cache_folder("kernels") != cache / "plgs" / "kernels"


def test_a_cache_folder_in_a_sticky_folder_such_as_tmp_is_used(cache: Path, tmp_path: Path) -> None:
    tmp_path.chmod(0o1777)
    assert choose_cache_folder("kernels") == cache / "plgs" / "kernels"


def test_without_a_cache_a_private_folder_is_made(cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(compiled_kernels, "user_cache_folder", lambda: tmp_path / "file")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    one, other = choose_cache_folder("kernels"), choose_cache_folder("kernels")
    assert one != other and one.stat().st_mode & 0o77 == 0
