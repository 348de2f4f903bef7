"""An index of tiny packages, a copy of the code whose engine is quick to warm up, and a folder for environments."""

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from engine.job.environment import module_of, needed_packages, requirement_file
from engine.set_up import SetUpRequest, uv_program
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


@pytest.fixture(autouse=True)
def large_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk with room for real packages: what these tests say must not depend on this machine's."""
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(1 << 40, 0, 1 << 40))


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


@pytest.fixture(scope="session")
def uv(root: Path) -> Path:
    """The pinned uv, which the set-up of the clone has left, or else downloads here."""
    return uv_program.fetch(root / "build", uv_program.variables(os.environ))


@pytest.fixture
def index(code: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PackageIndex]:
    needed = needed_packages(code, sys.version_info[:2])
    index = PackageIndex({name: (pin or "1.0", module_of(name)) for name, pin in needed.items()})
    requirement_file(code, "hashes", sys.version_info[:2]).write_text(index.hashes(without="torch"))
    requirement_file(code, "hashes-torch").write_text(index.hashes(only="torch"))
    for name in [name for name in os.environ if name.startswith(("PIP_", "UV_"))]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("UV_HTTP_RETRIES", "0")
    monkeypatch.setenv("UV_HTTP_TIMEOUT", f"{OUTLASTS_S:.0f}")
    monkeypatch.setenv("NO_PROXY", "*")
    yield index
    index.close()


@pytest.fixture
def folder(uv: Path, tmp_path: Path) -> Path:
    """A folder for environments, in which uv is already."""
    folder = tmp_path / "cache" / "plgs"
    (folder / uv.parent.name).mkdir(parents=True)
    shutil.copy(uv, folder / uv.parent.name)
    return folder


Begin = Callable[..., RunningSetUp]


@pytest.fixture
def begin(code: Path, folder: Path, index: PackageIndex) -> Iterator[Begin]:
    """Begins a set-up from the index."""
    begun: list[RunningSetUp] = []

    def begin_one(base: str = "", url: str = "") -> RunningSetUp:
        begun.append(RunningSetUp(SetUpRequest(Path(base) if base else None, "cpu", url or index.url), code, folder))
        return begun[-1]

    yield begin_one
    for running in begun:
        running.cancel()
