"""No command deletes or overwrites a file that it did not write, wherever it writes, stopped and unstopped."""

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from engine.job.own_files import OwnFiles
from tests.conftest import ROOT
from tests.raises_key import worded
from tests.segment.tiny_mask2former import save_tiny_mask2former
from tests.tiny_scene import write_tiny_scene

QUICK = ("--steps", "5", "--set", "warm_start=false")
"""Options that make a lift of the tiny room take seconds."""
_KILLED = """import os, runpy, signal, sys
at, put = int(sys.argv.pop(1)), os.replace
def replace(*paths):
    global at
    at -= 1
    os.kill(os.getpid(), signal.SIGKILL) if not at else put(*paths)
os.replace = replace
runpy.run_module("engine", run_name="__main__")
"""
Engine = Callable[..., str]
Command = Callable[[Path, Path], list[object]]
"""The arguments of a command, from a folder with a scene ``room`` and from a finished lift in it."""


def export(kind: str, where: str) -> Command:
    return lambda at, lift: ["export", lift, "--to", kind, "-o", (lift if where.startswith("exports/") else at) / where]


COMMANDS: dict[str, Command] = {
    "export to the lift's exports": export("boxes", "exports/boxes"),
    "export to a folder": export("coco", "out"),
    "export of many files": export("mesh", "out"),
    "bake": lambda at, lift: ["bake", lift, "--frames", "0001", "0002"],
    "bake to a folder": lambda at, lift: ["bake", lift, "--frames", "0001", "0002", "-o", at / "out"],
    "frames": lambda at, lift: ["frames", at / "room", "-o", at / "out"],
    "segment": lambda at, lift: ["segment", at / "bare", "--model", at / "network"],
    "inspect": lambda at, lift: ["inspect", at / "inverted", "-o", at / "out"],
    "inspect --fix": lambda at, lift: ["inspect", at / "inverted", "--fix", at / "out"],
    "classes": lambda at, lift: ["classes", at / "room", "--write", at / "edited.json"],
    "correct": lambda at, lift: ["correct", lift, "accept", "1"],
    "propose": lambda at, lift: ["correct", lift, "propose"],
    "evaluate": lambda at, lift: ["evaluate", lift],
    "find-scene": lambda at, lift: ["find-scene", lift, at / "room"],
    "lift": lambda at, lift: ["lift", at / "room", "-o", at / "again", "--resume", *QUICK],
    "batch": lambda at, lift: ["batch", at / "room", "-o", at / "out", "--export", "boxes", "--workers", "1", *QUICK],
}
REFUSED_THE_SECOND_TIME = {"inspect --fix"}
"""Commands that refuse a folder that is there."""


@pytest.fixture(scope="module")
def engine(quick_python: Path) -> Engine:
    """Run a command of the engine, which ends with ``code``, and return what it says on standard error. With ``killed``
    it is killed in the moment when it would put that file into its place (1: the first)."""

    def run(*arguments: object, code: int = 0, killed: int = 0, into: Path | None = None) -> str:
        program = [quick_python, ROOT / "engine/__main__.py"]
        program = [quick_python, "-c", _KILLED, str(killed)] if killed else program
        ran = subprocess.run([*program, *map(str, arguments)], capture_output=True, text=True)
        assert killed or ran.returncode == code, f"{ran.returncode}: {ran.stdout}{ran.stderr}"
        if into is not None:
            into.write_text(ran.stdout.splitlines()[-1])
        return ran.stderr

    return run


@pytest.fixture
def place(tmp_path: Path, lifted: Path) -> Iterator[tuple[Path, Path]]:
    """A folder with scenes as users have them, and a finished lift of one."""
    shutil.copytree(lifted / "scans/room", tmp_path / "room")
    shutil.copytree(lifted / "lifts/demo", tmp_path / "lift")
    write_tiny_scene(tmp_path / "bare", 3, masks="none", ground_truth=False)
    write_tiny_scene(tmp_path / "inverted", 8, (96, 72))
    for path in (tmp_path / "inverted" / "pose").iterdir():
        np.savetxt(path, np.linalg.inv(np.loadtxt(path)))
    yield tmp_path, tmp_path / "lift"


def prepared(name: str, at: Path, engine: Engine) -> None:
    if name == "segment":
        pytest.importorskip("transformers")
        save_tiny_mask2former(at / "network")
    if name == "classes":
        engine("classes", at / "room", "--json", into=at / "edited.json")
    if name == "batch":
        pytest.importorskip("distributed")


def plant(folder: Path, name: str) -> dict[Path, bytes]:
    """Put a file into every folder below. Returns all files there that no command of ours wrote into this place."""
    for each in [folder, *(path for path in folder.rglob("*") if path.is_dir())]:
        (each / name).write_bytes(f"{name} of somebody else".encode())
    return {path: path.read_bytes() for path in folder.rglob(name)}


def refuse_loss(strangers: dict[Path, bytes]) -> None:
    lost = [path for path, content in strangers.items() if not path.is_file() or path.read_bytes() != content]
    assert not lost


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_deletes_files_of_other_people(name: str, place: tuple[Path, Path], engine: Engine) -> None:
    at, lift = place
    prepared(name, at, engine)
    arguments = COMMANDS[name](at, lift)
    theirs = {path: path.read_bytes() for path in (at / "room").rglob("*") if path.is_file()}
    engine(*arguments, killed=3)  # which leaves what it wrote, and parts
    strangers = plant(at, "notes.txt")
    engine(*arguments)
    refuse_loss(strangers | theirs)
    strangers |= plant(at, "notes.blend")
    engine(*arguments, code=2 if name in REFUSED_THE_SECOND_TIME else 0)
    refuse_loss(strangers | theirs)


CLASHES = {
    "export to the lift's exports": "lift/exports/boxes/boxes.csv",
    "export to a folder": "out/instances.json",
    "bake": "lift/result/passes/0001.exr",
    "bake to a folder": "out/0001.exr",
    "frames": "out/depth/0002.png",
    "segment": "bare/panoptic/0002.png",
    "inspect": "out/findings.json",
    "batch": "out/table.csv",
}


@pytest.mark.parametrize("name", CLASHES)
def test_a_strangers_file_in_place_of_output_is_refused(name: str, place: tuple[Path, Path], engine: Engine) -> None:
    """Before the first run, while it was stopped, or in place of what we wrote."""
    at, lift = place
    prepared(name, at, engine)
    arguments, path = COMMANDS[name](at, lift), at / CLASHES[name]
    if "bake" not in name and name != "batch":
        engine(*arguments, killed=3 if name in ("frames", "segment") else 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"mine")
    told = engine(*arguments, code=2)
    assert worded("foreign-file").search(told) and path.name in told and path.read_bytes() == b"mine"


def test_a_stopped_export_is_not_marked_complete(place: tuple[Path, Path], engine: Engine) -> None:
    at, lift = place
    arguments = COMMANDS["export to the lift's exports"](at, lift)
    engine(*arguments, killed=2)
    assert not OwnFiles(lift / "exports/boxes").is_complete
    engine(*arguments)
    assert OwnFiles(lift / "exports/boxes").is_complete


def test_exporting_into_the_folder_of_all_exports_is_refused(place: tuple[Path, Path], engine: Engine) -> None:
    _, lift = place
    engine("export", lift, "--to", "boxes", "-o", lift / "exports/boxes")
    before = {path: path.read_bytes() for path in (lift / "exports").rglob("*") if path.is_file()}
    assert worded("all-exports").search(engine("export", lift, "--to", "coco", "-o", lift / "exports", code=2))
    assert {path: path.read_bytes() for path in (lift / "exports").rglob("*") if path.is_file()} == before


@pytest.mark.slow
def test_a_strangers_file_in_a_result_folder_survives_the_next_lift(place: tuple[Path, Path], engine: Engine) -> None:
    at, _ = place
    arguments = COMMANDS["lift"](at, at)
    engine(*arguments, killed=20)
    notes = at / "again/result/notes.txt"
    notes.parent.mkdir(exist_ok=True)
    notes.write_text("mine")
    engine(*arguments)
    (at / "room/panoptic.json").write_text((at / "room/panoptic.json").read_text().replace('"chair"', '"seat"'))
    engine(*arguments)
    assert (at / "again/earlier/1/notes.txt").read_text() == "mine"
