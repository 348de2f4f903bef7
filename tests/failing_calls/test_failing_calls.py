"""One call to the file system fails, as each command makes it: the command ends with one line and its exit code, no
half file is taken for whole, and the same command again ends in the same bits. `make test-failing-calls` runs it.

PLGS_FAULTS is the number of faults that each command meets (0: all). Where a command makes more calls, some are
sampled: the first and the last of each kind and file before others.
"""

from __future__ import annotations

import os
import subprocess
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
from tests.failing_calls.failing import Commands, State, faults_of, renewed
from tests.tiny_scene import write_tiny_scene

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="a library is preloaded"),
]
MOST = int(os.environ.get("PLGS_FAULTS", "30")) or sys.maxsize
TINY = ("--steps", "2", "--set", "warm_start=false")
FORMS = ("coco", "instances", "scannet", "points", "boxes", "mesh", "depth", "clouds")
Run = Callable[..., tuple[int, str]]


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
def state(place: Path) -> State:
    return State(place, place / "work")


@pytest.fixture(scope="module")
def commands(place: Path, state: State) -> Iterator[Commands]:
    scene = write_tiny_scene(place / "scene", frames=5, size=(32, 24))
    started = Commands(scene, place, state)
    yield started
    started.close()


@pytest.fixture(scope="module")
def asked(place: Path, commands: Commands) -> Path:
    """A folder with a lift that was not begun."""
    request = LiftRequest(scene=place / "scene", options={"steps": 2, "warm_start": False})
    LiftFolder.create(place / "asked" / "lift", request)
    return place / "asked"


@pytest.fixture(scope="module")
def lifted(place: Path, asked: Path, commands: Commands) -> Path:
    renewed(place / "lifted", asked)
    assert commands.run("lift", place / "lifted" / "lift")[0] == 0
    return place / "lifted"


def test_lift(place: Path, asked: Path, state: State, commands: Commands) -> None:
    work = place / "work" / "lift"
    lift = Attacked("lift", asked, ("lift", work, "--resume"), result_of, whole_result)
    attack(lift, state, commands.run, work.parent)


def test_resume(place: Path, asked: Path, state: State, commands: Commands) -> None:
    """A lift that was stopped when its second checkpoint was due."""
    work = place / "work" / "lift"
    renewed(work.parent, asked)
    state.set()
    assert commands.run("lift", work)[0] == 0
    at = [number for number, (_, file) in enumerate(state.calls(), start=1) if ".part-checkpoint" in file][-1]
    renewed(work.parent, asked)
    state.set(at, 5)
    assert commands.run("lift", work)[0] != 0 and state.failed
    renewed(place / "stopped", work.parent)
    stopped = Attacked("resume", place / "stopped", ("lift", work, "--resume"), result_of, whole_result)
    attack(stopped, state, commands.run, work.parent)


def test_bake(place: Path, lifted: Path, state: State, commands: Commands) -> None:
    work = place / "work" / "lift"
    attack(Attacked("bake", lifted, ("bake", work), result_of, whole_result), state, commands.run, work.parent)


@pytest.mark.parametrize("form", FORMS)
def test_export(place: Path, lifted: Path, state: State, commands: Commands, form: str) -> None:
    work = place / "work"
    export = ("export", work / "lift", "--to", form, "-o", work / "out")
    attack(Attacked(f"export --to {form}", lifted, export, exported, whole_files), state, commands.run, work)


def test_correct(place: Path, state: State, commands: Commands) -> None:
    lift = LiftFolder.create(place / "made" / "lift", LiftRequest(scene=place / "scene")).path
    write_manifest(write_result(lift) / "result", versions={}, seed=0, settings={}, timings={})
    work = place / "work"
    rename = ("correct", work / "lift", "rename", "1", "two chairs")
    attack(Attacked("correct", place / "made", rename, corrected), state, commands.run, work)


def test_lift_in_a_terminal(place: Path, root: Path, state: State, commands: Commands) -> None:
    """Calls of the process that shows the progress. It starts another for the lift, of which none fails."""
    work = place / "work"
    lift = ("lift", place / "scene", "-o", work / "lift", "--resume", "--bake", "none", *TINY)
    attacked = Attacked("lift in a terminal", empty(place), lift, result_of, whole_result, most=max(4, MOST // 4))
    attack(attacked, state, started(root, state.variables | {"PLGS_FAIL_ALONE": "1"}), work)


def test_batch(place: Path, root: Path, state: State, commands: Commands) -> None:
    """Calls of the batch and its worker. Its engines, which leave LD_PRELOAD behind, make those of `test_lift`."""
    work = place / "work"
    batch = ("batch", place / "scene", "-o", work / "out", "--workers", "1", "--bake", "none", *TINY)
    attacked = Attacked("batch", empty(place), batch, batched, most=max(4, MOST // 4))
    attack(attacked, state, started(root, state.variables), work)


def empty(place: Path) -> Path:
    (place / "empty").mkdir(exist_ok=True)
    return place / "empty"


def started(root: Path, variables: dict[str, str]) -> Run:
    """Runs a command in a process of its own."""

    def run(*arguments: str | Path) -> tuple[int, str]:
        command = [sys.executable, "-m", "engine", *map(str, arguments)]
        ended = subprocess.run(
            command, cwd=root, env=os.environ | variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=400
        )
        return ended.returncode, ended.stdout.decode(errors="replace")

    return run


def attack(attacked: Attacked, state: State, run: Run, work: Path) -> None:
    """Run it undisturbed, then with each fault. All that is wrong is told at the end."""
    renewed(work, attacked.before)
    state.set()
    code, said = run(*attacked.arguments)
    assert code == 0, said
    calls, calm = state.calls(), attacked.found(work)
    met: Counter[str] = Counter()
    wrong = []
    for fault in faults_of(calls, attacked.most):
        renewed(work, attacked.before)
        state.set(fault.at, fault.error)
        try:
            met[_disturbed(attacked, calm, state, run, work)] += 1
        except AssertionError as error:
            wrong.append(f"{fault} ({state.failed}): {error}")
            print(wrong[-1], flush=True)
    kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(Counter(kind for kind, _ in calls).items()))
    row = (attacked.name, kinds, met.total(), *(met[how] for how in ("told", "did without", "not reached")))
    print("|", " | ".join(map(str, row)), "|", flush=True)
    assert not wrong, f"{len(wrong)} faults:\n" + "\n".join(wrong)


def _disturbed(attacked: Attacked, calm: object, state: State, run: Run, work: Path) -> str:
    code, said = run(*attacked.arguments)
    how = "not reached" if not state.failed else "told" if code else "did without"
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert "Traceback" not in said, said
    if code:  # a batch's table has the line of each scene
        assert code in (1, 2, 75) and (len(errors) == 1 or attacked.name == "batch"), f"code {code}: {said}"
        attacked.half(work, calm)
    else:
        assert attacked.found(work) == calm, "ended with code 0 and other bits"
    state.set()
    code, said = run(*attacked.arguments)
    assert code == 0, f"again: code {code}: {said}"
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
