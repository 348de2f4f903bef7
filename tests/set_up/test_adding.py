"""Adding a part to an engine's environment with a real uv: to the end, cut off, cancelled."""

import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from engine.errors import Cancelled
from engine.job import EventWriter, StopSignal
from engine.job.environment import python_in, requirement_file
from engine.job.handshake import ADDED, CAPABILITIES, EngineAnswer, answer
from engine.job.process import engine_call, missing_modules
from engine.set_up import Addition
from tests.raises_key import raises_key
from tests.set_up.package_index import PackageIndex, wheel
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the folders of POSIX")
NAME = "colmap"


@pytest.fixture
def part(code: Path, index: PackageIndex) -> Iterator[PackageIndex]:
    """An index that has a tiny package in the place of the real one."""
    tiny = PackageIndex(
        {"pycolmap": (requirement_file(code, NAME).read_text().rpartition("==")[2].strip(), "pycolmap")}
    )
    requirement_file(code, f"hashes-{NAME}").write_text(tiny.hashes(without=""))
    yield tiny
    tiny.close()


@pytest.fixture
def environment(uv: Path, folder: Path) -> Path:
    subprocess.run([uv, "venv", "--quiet", "--python", sys.executable, folder / "engine"], check=True, timeout=120)
    return folder / "engine"


def addition(code: Path, environment: Path, part: PackageIndex, stop: StopSignal | None = None) -> Addition:
    events = EventWriter(Path(tempfile.mkdtemp(prefix="plgs-test-")) / "events.jsonl")
    return Addition(
        NAME,
        events,
        stop or StopSignal(),
        root=code,
        environment=environment,
        index_url=part.url,
        tools=environment.parent,
    )


def files_of(environment: Path) -> set[str]:
    """All files but notes of what was tried."""
    paths = {str(path.relative_to(environment)) for path in environment.rglob("*") if path.is_file()}
    return {path for path in paths if "__pycache__" not in path} - {"add.log", "add.lock"}


def says_to_lack(code: Path, environment: Path) -> tuple[str, ...]:
    command = [*engine_call(python_in(environment), code), "handshake"]
    said = EngineAnswer.from_line(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return said.capabilities[NAME]


def test_packages_added_to_the_engine_are_found_and_reported(code: Path, environment: Path, part: PackageIndex) -> None:
    assert "pycolmap" in says_to_lack(code, environment)
    before = files_of(environment)
    folder = addition(code, environment, part).run()
    assert missing_modules(python_in(environment), ["pycolmap"]) == []
    assert "pycolmap" not in says_to_lack(code, environment)
    new = files_of(environment) - before
    assert {path.split("/")[0] for path in new if not path.endswith(".pth")} == {"added"} and not list(
        folder.glob("tmp")
    )
    assert addition(code, environment, part).run() == folder, "adding it again is no fault"
    assert files_of(environment) - before == new


@pytest.mark.parametrize("fault", ["cut", "garbage", "exchanged", "elsewhere"])
def test_a_failed_addition_changes_no_engine(fault: str, code: Path, environment: Path, part: PackageIndex) -> None:
    before = files_of(environment)
    if fault == "exchanged":
        name, _ = part.wheels["pycolmap"]
        part.wheels["pycolmap"] = name, wheel("pycolmap", name.split("-")[1], "other")[1]
    else:
        part.fault["pycolmap"] = fault
    with raises_key("uv-failed"):
        addition(code, environment, part).run()
    assert files_of(environment) == before


def test_a_cancelled_addition_of_packages_keeps_the_engine(code: Path, environment: Path, part: PackageIndex) -> None:
    before, stop, ended = files_of(environment), StopSignal(), list[BaseException]()
    part.fault["pycolmap"] = "stall"

    def run() -> None:
        try:
            addition(code, environment, part, stop).run()
        except Cancelled as cancelled:
            ended.append(cancelled)

    thread = threading.Thread(target=run)
    thread.start()
    assert part.stalled.wait(PATIENCE_S)
    stop.ask("the test is over")
    thread.join(PATIENCE_S)
    assert ended and files_of(environment) == before


def test_packages_are_never_added_to_the_systems_python(code: Path, tmp_path: Path, part: PackageIndex) -> None:
    with raises_key("not-environment"):
        addition(code, tmp_path, part).run()


@pytest.mark.parametrize("name", ADDED)
def test_added_packages_are_pinned_by_hash_for_every_system(name: str, root: Path) -> None:
    pins = [line.split("==")[0] for line in requirement_file(root, name).read_text().splitlines() if "==" in line]
    assert set(CAPABILITIES[name].packages) <= set(pins)
    entries = requirement_file(root, f"hashes-{name}").read_text().split("\n")
    pinned = [line.split(" ")[0] for line in entries if "==" in line]
    assert set(CAPABILITIES[name].packages) <= {each.split("==")[0] for each in pinned}
    for line in requirement_file(root, name).read_text().splitlines():
        assert "==" not in line or line in pinned or line.startswith("setuptools")


def test_the_handshake_names_every_ability_of_the_engine() -> None:
    said = answer()
    assert set(said.capabilities) == set(CAPABILITIES)
    missing = set(said.missing)
    assert all(missing <= set(lacking) for lacking in said.capabilities.values())
