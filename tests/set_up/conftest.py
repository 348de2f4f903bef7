"""An index of tiny packages, a copy of the code whose engine is quick to warm up, and a folder for environments."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from engine.job.environment import hashes_path, module_of, needed_packages, python_in
from engine.set_up import SetUpRequest
from engine.set_up.environments import Notes
from tests.set_up.package_index import PackageIndex
from tests.set_up.running import RunningSetUp
from tests.waiting import OUTLASTS_S

# The engine as it is, but warming up only imports what was installed.
MAIN = """
import os, sys
if sys.argv[1] == "warm-up":
    import torch, numba
    print("compiled for", torch.__version__)
else:
    sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    from engine.command_line.main import main
    sys.exit(main(sys.argv[1:]))
"""


@contextmanager
def large_disk() -> Iterator[None]:
    """A disk with room for real packages: what these tests say must not depend on this machine's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(1 << 40, 0, 1 << 40))
        yield


@pytest.fixture(autouse=True)
def room_on_the_disk() -> Iterator[None]:
    """For each test alone: those of other folders, between two of these, have the machine's own disk."""
    with large_disk():
        yield


@pytest.fixture(scope="session")
def code(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The code's folder, as far as a set-up looks at it."""
    code = tmp_path_factory.mktemp("code")
    shutil.copytree(root / "requirements", code / "requirements")
    (code / "engine").mkdir()
    for path in (root / "engine").iterdir():
        if path.name not in ("__main__.py", "__pycache__"):
            (code / "engine" / path.name).symlink_to(path)
    (code / "engine" / "__main__.py").write_text(MAIN)
    return code


@pytest.fixture
def index(code: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[PackageIndex]:
    needed = needed_packages(code, sys.version_info[:2])
    index = PackageIndex({name: (pin or "1.0", module_of(name)) for name, pin in needed.items()})
    hashes_path(code, sys.version_info[:2]).write_text(index.hashes(without="torch"))
    for name in ("PIP_FIND_LINKS", "PIP_EXTRA_INDEX_URL", "PIP_INDEX_URL", "PIP_NO_INDEX"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    monkeypatch.setenv("PIP_CACHE_DIR", str(tmp_path / "pip-cache"))
    monkeypatch.setenv("PIP_RETRIES", "0")
    monkeypatch.setenv("PIP_DEFAULT_TIMEOUT", f"{OUTLASTS_S:.0f}")
    monkeypatch.setenv("NO_PROXY", "*")
    yield index
    index.close()


@pytest.fixture(scope="session")
def empty_environment(code: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the set-up's second step made: a real environment with a real pip, cancelled there."""
    folder = tmp_path_factory.mktemp("empty")
    with large_disk():
        running = RunningSetUp(SetUpRequest(Path(sys.executable), index_url="http://127.0.0.1:9"), code, folder)
        running.wait(until=lambda: any(Notes.read(each) for each in folder.glob("engine-*")))
        running.cancel()
    return next(folder.glob("engine-*"))


@pytest.fixture
def folder(empty_environment: Path, tmp_path: Path) -> Path:
    """A folder for environments, in which the set-up's first steps are done."""
    folder = tmp_path / "cache" / "plgs"
    shutil.copytree(empty_environment, folder / empty_environment.name, symlinks=True)
    assert python_in(folder / empty_environment.name).exists()
    return folder


Begin = Callable[..., RunningSetUp]


@pytest.fixture
def begin(code: Path, folder: Path, index: PackageIndex) -> Iterator[Begin]:
    """Begins a set-up from the index."""
    begun: list[RunningSetUp] = []

    def begin_one(base: str = sys.executable, build: str = "cpu", url: str = "") -> RunningSetUp:
        begun.append(RunningSetUp(SetUpRequest(Path(base), build, url or index.url), code, folder))
        return begun[-1]

    yield begin_one
    for running in begun:
        running.cancel()
