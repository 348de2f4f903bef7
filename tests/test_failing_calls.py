"""One call to the file system fails, as each command makes it: the command ends with one line and its exit code, no
half file is taken for whole, and the same command again ends in the same bits. `make test-failing-calls` runs it.

PLGS_FAULTS is the number of faults that each command meets (0: all). Where a command makes more calls, some are
sampled: the first and the last of each kind and file before others.
"""

from __future__ import annotations

import errno
import os
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
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
MOST = int(os.environ.get("PLGS_FAULTS", "30")) or sys.maxsize
TINY = ("--steps", "2", "--set", "warm_start=false")
FORMS = ("coco", "instances", "scannet", "points", "boxes", "mesh", "depth", "clouds")
ERRORS = (errno.EIO, errno.ENOSPC, errno.EDQUOT)


@dataclass(frozen=True)
class Attacked:
    """A command in the folder that it begins with, ``before``. ``found`` tells what came of it, and raises an error
    where something there is half."""

    name: str
    before: Path
    arguments: tuple[str | Path, ...]
    found: Callable[[Path], object]
    half: Callable[[Path, object], object] = lambda folder, calm: None
    most: int = MOST


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("failing")


@pytest.fixture(scope="module")
def engines(place: Path) -> Iterator[Engines]:
    started = Engines(write_tiny_scene(place / "scene", frames=5, size=(32, 24)), place)
    yield started
    started.close()


@pytest.fixture(scope="module")
def asked(place: Path, engines: Engines) -> Path:
    """A folder with a lift that was not begun."""
    request = LiftRequest(scene=place / "scene", options={"steps": 2, "warm_start": False})
    LiftFolder.create(place / "asked" / "lift", request)
    return place / "asked"


@pytest.fixture(scope="module")
def lifted(place: Path, asked: Path, engines: Engines) -> Path:
    renewed(place / "lifted", asked)
    assert engines.run("lift", place / "lifted" / "lift") == 0
    return place / "lifted"


def test_lift(place: Path, asked: Path, engines: Engines) -> None:
    work = place / "work" / "lift"
    attack(Attacked("lift", asked, ("lift", work, "--resume"), result_of, whole_result), engines, work.parent)


def test_resume(place: Path, asked: Path, engines: Engines) -> None:
    """A lift that was stopped when its second checkpoint was due."""
    work = place / "work" / "lift"
    renewed(work.parent, asked)
    assert engines.run("lift", work, fault=Fault(str(work.parent))) == 0
    at = [number for number, (_, file) in enumerate(engines.counted()[0], start=1) if ".part-checkpoint" in file][-1]
    renewed(work.parent, asked)
    assert engines.run("lift", work, fault=Fault(str(work.parent), at, errno.EIO)) != 0 and engines.counted()[1]
    renewed(place / "stopped", work.parent)
    stopped = Attacked("resume", place / "stopped", ("lift", work, "--resume"), result_of, whole_result)
    attack(stopped, engines, work.parent)


def test_bake(place: Path, lifted: Path, engines: Engines) -> None:
    work = place / "work" / "lift"
    attack(Attacked("bake", lifted, ("bake", work), result_of, whole_result), engines, work.parent)


@pytest.mark.parametrize("form", FORMS)
def test_export(place: Path, lifted: Path, engines: Engines, form: str) -> None:
    work = place / "work"
    export = ("export", work / "lift", "--to", form, "-o", work / "out")
    attack(Attacked(f"export --to {form}", lifted, export, exported, whole_files), engines, work)


def test_correct(place: Path, engines: Engines) -> None:
    lift = LiftFolder.create(place / "made" / "lift", LiftRequest(scene=place / "scene")).path
    write_manifest(write_result(lift) / "result", versions={}, seed=0, settings={}, timings={})
    work = place / "work"
    rename = ("correct", work / "lift", "rename", "1", "two chairs")
    attack(Attacked("correct", place / "made", rename, corrected), engines, work)


@pytest.mark.parametrize("command", ["lift", "batch"])
def test_commands_that_start_others(place: Path, engines: Engines, command: str) -> None:
    """Calls of the process that shows the progress. Those that it starts make those of `test_lift`, and none fails."""
    work, empty = place / "work", place / "empty"
    empty.mkdir(exist_ok=True)
    options = ("-o", work / "lift", "--resume") if command == "lift" else ("-o", work / "out", "--workers", "1")
    arguments = (command, place / "scene", *options, "--bake", "none", *TINY)
    found, half = (result_of, whole_result) if command == "lift" else (batched, lambda folder, calm: None)
    attack(Attacked(command, empty, arguments, found, half, most=max(4, MOST // 4)), engines, work)


def renewed(folder: Path, before: Path) -> None:
    """Make ``folder`` a copy of ``before``."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(before, folder)


def faults_of(calls: list[tuple[str, str]], below: Path, most: int) -> list[Fault]:
    """Each call with each error that it may have. Where that is more than ``most``: calls at equal distances of the
    first and the last of each kind and file, with errors in turns."""

    def errors(kind: str) -> tuple[int, ...]:
        return (*ERRORS, errno.EMFILE) if kind == "open" else ERRORS

    numbered = [(at, (kind, file)) for at, (kind, file) in enumerate(calls, start=1)]
    every = [Fault(str(below), at, error) for at, (kind, _) in numbered for error in errors(kind)]
    if len(every) <= most:
        return every
    ends = sorted({*dict((call, at) for at, call in numbered).values(),
                   *dict((call, at) for at, call in reversed(numbered)).values()})  # fmt: skip
    sampled = ends if len(ends) <= most else [ends[number * len(ends) // most] for number in range(most)]
    found = []
    for turn, at in enumerate(sampled):
        able = errors(calls[at - 1][0])
        found.append(Fault(str(below), at, able[turn % len(able)]))
    return found


def attack(attacked: Attacked, engines: Engines, work: Path) -> None:
    """Run it undisturbed, then with each fault. All that is wrong is told at the end."""
    renewed(work, attacked.before)
    code = engines.run(*attacked.arguments, fault=Fault(str(work)))
    assert code == 0, engines.said
    calls, calm = engines.counted()[0], attacked.found(work)
    met: Counter[str] = Counter()
    wrong = []
    for fault in faults_of(calls, work, attacked.most):
        renewed(work, attacked.before)
        try:
            met[_disturbed(attacked, calm, engines, fault, work)] += 1
        except AssertionError as error:
            wrong.append(f"{errno.errorcode[fault.error]} at {fault.at}, {calls[fault.at - 1]}: {error}")
            print(wrong[-1], flush=True)
    kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(Counter(kind for kind, _ in calls).items()))
    row = (attacked.name, kinds, met.total(), *(met[how] for how in ("told", "did without", "not reached")))
    print("|", " | ".join(map(str, row)), "|", flush=True)
    assert not wrong, f"{len(wrong)} faults:\n" + "\n".join(wrong)


def _disturbed(attacked: Attacked, calm: object, engines: Engines, fault: Fault, work: Path) -> str:
    code = engines.run(*attacked.arguments, fault=fault)
    said, (_, failed) = engines.said, engines.counted()
    how = "not reached" if not failed else "told" if code else "did without"
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert "Traceback" not in said, said
    if code:  # a batch's table has the line of each scene
        assert code in (1, 2, 75) and (len(errors) == 1 or attacked.name == "batch"), f"code {code}: {said}"
        attacked.half(work, calm)
    else:
        assert attacked.found(work) == calm, "ended with code 0 and other bits"
    code = engines.run(*attacked.arguments)
    assert code == 0, f"again: code {code}: {engines.said}"
    assert attacked.found(work) == calm, "again: other bits"
    return how


def result_of(work: Path) -> object:
    return verify(work / "lift" / "result").files


def batched(work: Path) -> object:
    return verify(work / "out" / "scene" / "result").files


def whole_result(work: Path, calm: object) -> None:
    """A result that has a manifest is as that says; a checkpoint that is there can be read."""
    if not (work / "lift" / "request.json").exists():
        return
    folder = LiftFolder.open(work / "lift")
    if folder.manifest_path.exists():
        verify(folder.result_path)
    folder.checkpoints.latest()


def exported(work: Path) -> dict[str, str]:
    """The files of an export that have their names, with their checksums."""
    found = sorted(path for path in (work / "out").rglob("*") if path.is_file() and not path.name.startswith(".part-"))
    return {str(path.relative_to(work)): sha256(path.read_bytes()).hexdigest() for path in found}


def whole_files(work: Path, calm: object) -> None:
    assert isinstance(calm, dict) and exported(work).items() <= calm.items(), "a file is not whole"


def corrected(work: Path) -> list[str]:
    """The names; each edit has its own time."""
    return [one.name for one in read_corrected(work / "lift").instances]
