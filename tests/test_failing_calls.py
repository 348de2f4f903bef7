"""One call to the file system fails, as each command makes it: the command ends with one line and its exit code, no
half file counts as whole, and the same command again ends in the same bits. `make test-failing-calls` runs it.

PLGS_FAULTS is the number of calls that fail for each command (0: all), spread over the first and last call of each kind
and file.
"""

import errno
import os
import shutil
import sys
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

import pytest

from engine.corrections import read_corrected
from engine.job import LiftFolder, LiftRequest, verify, write_manifest
from tests.corrections.two_rooms import write_result
from tests.killed_engine import Engines, Fault
from tests.tiny_scene import write_tiny_scene

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="descriptors are looked up as Linux has them"),
]
MOST = int(os.environ.get("PLGS_FAULTS", "30"))
ERRORS = (errno.EIO, errno.ENOSPC, errno.EDQUOT)
COMMANDS = {
    "lift": ("lift", "LIFT", "--resume"),
    "bake": ("bake", "LIFT"),
    "correct": ("correct", "LIFT", "rename", "1", "two chairs"),
    **{
        f"export {form}": ("export", "LIFT", "--to", form, "-o", "OUT")
        for form in ("coco", "instances", "scannet", "points", "boxes", "mesh", "depth", "clouds")
    },
}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the lifts with which commands begin: not begun, finished, and made by hand."""
    place = tmp_path_factory.mktemp("failing")
    scene = write_tiny_scene(place / "scene", frames=5, size=(32, 24))
    LiftFolder.create(place / "asked" / "lift", LiftRequest(scene=scene, options={"steps": 2, "warm_start": False}))
    made = LiftFolder.create(place / "made" / "lift", LiftRequest(scene=scene)).path
    write_manifest(write_result(made) / "result", versions={}, seed=0, settings={}, timings={})
    return place


@pytest.fixture(scope="module")
def engines(place: Path) -> Iterator[Engines]:
    started = Engines(place / "scene", place)
    shutil.copytree(place / "asked", place / "lifted")
    assert started.run("lift", place / "lifted" / "lift") == 0
    yield started
    started.close()


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_survive_failing_system_calls(place: Path, engines: Engines, command: str) -> None:
    work, before = place / "work", place / {"lift": "asked", "correct": "made"}.get(command, "lifted")
    paths = {"LIFT": str(work / "lift"), "OUT": str(work / "out")}
    arguments = [paths.get(each, each) for each in COMMANDS[command]]
    renew(work, before)
    assert engines.run(*arguments, fault=Fault(str(work))) == 0, engines.said
    calls, whole = engines.counted()[0], found_in(work)
    for turn, at in enumerate(chosen(calls)):
        error = ERRORS[turn % len(ERRORS)]
        print(f"{errno.errorcode[error]} at {at}, {calls[at - 1]}")  # for a test that fails
        renew(work, before)
        code = engines.run(*arguments, fault=Fault(str(work), at, error))
        assert "Traceback" not in engines.said, engines.said
        left = found_in(work)
        if code:
            errors = [line for line in engines.said.splitlines() if line.startswith("error: ")]
            assert code in (1, 2) and len(errors) == 1, engines.said
            assert left.items() - {("names", left.get("names", ""))} <= whole.items(), "a file is not whole"
        else:
            assert left == whole
        assert engines.run(*arguments) == 0, engines.said
        assert found_in(work) == whole


def renew(folder: Path, before: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(before, folder)


def chosen(calls: list[tuple[str, str]]) -> list[int]:
    """The numbers of the calls that fail, from 1."""
    numbered = [(call, at) for at, call in enumerate(map(tuple, calls), start=1)]
    ends = sorted({*dict(numbered).values(), *dict(reversed(numbered)).values()})
    if not MOST:
        return [at for _, at in numbered]
    return ends if len(ends) <= MOST else [ends[number * len(ends) // MOST] for number in range(MOST)]


def found_in(work: Path) -> dict[str, str]:
    """The checksums of a result and of exported files, and the objects' names. Raises an error where one is half."""
    lift = LiftFolder.open(work / "lift")
    lift.checkpoints.latest()
    files = verify(lift.result_path).files if lift.manifest_path.exists() else ()
    found = {str(file.path): file.sha256 for file in files}
    for path in (path for path in (work / "out").rglob("*") if path.is_file() and not path.name.startswith(".part-")):
        found[str(path.relative_to(work))] = sha256(path.read_bytes()).hexdigest()
    if (lift.path / "corrections.json").exists():
        found["names"] = " ".join(one.name for one in read_corrected(lift.path).instances)
    return found
