"""Whichever call fails and whenever the power is cut, the old or the new state is whole, and the next run continues."""

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from engine import job
from engine.command_line.run_engine import run_engine
from engine.errors import ErrorCode, PlgsError
from engine.job.events import last_events
from engine.job.recent import remember_lift, remembered_lifts
from tests.faults import Faults, Recorder, after_power_cuts, every_fault
from tests.job.following import new_lift, tiny_lift

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="descriptors are looked up as Linux has them")


@pytest.fixture(autouse=True)
def _no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


Prepare = Callable[[Path], object]
Rounds = Callable[[Prepare, Prepare], Iterator[Path]]
"""Makes a fresh folder again and again, lets work meet a fault in it, and hands the folder over for a look."""


def fault_rounds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thoroughly: bool) -> Rounds:
    """Every call of the file system fails, one after the other; ``thoroughly``: with each error."""

    def rounds(prepare: Prepare, work: Prepare) -> Iterator[Path]:
        whole = tmp_path / "whole"
        whole.mkdir()
        prepare(whole)
        faults = Faults(tmp_path / "spoilt", monkeypatch)
        for at, error, for_good in every_fault(faults, thoroughly):
            shutil.copytree(whole, tmp_path / "spoilt")
            try:
                with faults.failing(at, error, for_good):
                    work(tmp_path / "spoilt")
            except (OSError, PlgsError) as met:
                assert faults.has_failed and "\n" not in str(met), met
            print(f"{errno.errorcode.get(error, 'short')} at call {at}: {faults.failed[:3]}")  # for a test that fails
            yield tmp_path / "spoilt"
            shutil.rmtree(tmp_path / "spoilt")
        assert at > 3

    return rounds


def power_cuts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seeds: int) -> Rounds:
    """Work is recorded, and unsynced writes are dropped and reordered, as power cuts may leave them."""

    def rounds(prepare: Prepare, work: Prepare) -> Iterator[Path]:
        folder = tmp_path / "recorded"
        folder.mkdir()
        prepare(folder)
        recorder = Recorder(folder, monkeypatch)
        with recorder.recording():
            work(folder)
        assert len(recorder.changes) > 2
        yield from after_power_cuts(recorder, tmp_path / "left", seeds)

    return rounds


FAULTS = [
    pytest.param((fault_rounds, False), id="each call fails"),
    pytest.param((fault_rounds, True), id="each call fails in each way", marks=pytest.mark.slow),
]
CUTS = [
    pytest.param((power_cuts, 5), id="few power cuts"),
    pytest.param((power_cuts, 200), id="many power cuts", marks=pytest.mark.slow),
]


@pytest.fixture(params=[*FAULTS, *CUTS])
def rounds(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rounds:
    make, how = request.param
    made: Rounds = make(tmp_path, monkeypatch, how)
    return made


def test_the_simulated_disk_loses_writes_without_fsync(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The harness itself: a file that is replaced without fsync may be empty."""

    def replace(folder: Path) -> None:
        (folder / "part").write_text("new")
        os.replace(folder / "part", folder / "file")

    cuts = power_cuts(tmp_path, monkeypatch, 5)
    left = cuts(lambda folder: (folder / "file").write_text("old"), replace)
    assert {"old", "new", ""} <= {(folder / "file").read_text() for folder in left}


def test_events_survive_every_disk_fault(rounds: Rounds, request: pytest.FixtureRequest) -> None:
    told: list[int] = []
    loses_nothing = request.node.callspec.params["rounds"][0] is fault_rounds

    def tell(folder: Path) -> None:
        told.clear()
        writer = job.EventWriter(folder / "events.jsonl")
        for step in range(4):
            try:
                writer.progress("train", step, 4)
                told.append(step)
            except OSError:
                continue
        writer.error(PlgsError("made-up", "broke", "here", "Mend it.", code=ErrorCode.INTERNAL))

    def earlier(folder: Path) -> None:
        job.EventWriter(folder / "events.jsonl").hello(threads=1, resumed=False)

    for folder in rounds(earlier, tell):
        job.EventWriter(folder / "events.jsonl").warning("goes on")
        events = job.EventReader(folder / "events.jsonl").poll()
        steps = [event.data["step"] for event in events if event.kind == "progress"]
        assert events[-1].kind == "warning"
        if loses_nothing:  # events are not synced, since there are many: a power cut may lose some
            assert events[0].kind == "hello" and [step for step in steps if step in told] == told
        assert all(one.seq < other.seq for one, other in zip(events, events[1:], strict=False))


@pytest.mark.parametrize("content", ["new", lambda part: part.write_text("new")], ids=["text", "function"])
def test_an_atomically_written_file_survives_a_fault(rounds: Rounds, content: str | Callable[[Path], object]) -> None:
    def replace(folder: Path) -> None:
        job.write_atomically(folder / "file", content)

    found = set()
    for folder in rounds(lambda folder: (folder / "file").write_text("old"), replace):
        found.add((folder / "file").read_text())
        job.write_atomically(folder / "file", "newer")
        assert (folder / "file").read_text() == "newer"
    assert found == {"old", "new"}


def lay(result: Path, *names: str) -> None:
    for name in names:
        job.write_atomically(result / name, f"content of {name}")


def finish(result: Path) -> None:
    job.write_manifest(result, versions={}, seed=0, settings={}, timings={})


def names_in(result: Path) -> set[str]:
    return {str(file.path) for file in job.verify(result).files}


def test_a_new_manifest_survives_every_disk_fault(rounds: Rounds) -> None:
    for result in rounds(lambda result: lay(result, "a", "b"), finish):
        if (result / "manifest.json").exists():
            assert names_in(result) == {"a", "b"}
        finish(result)
        assert names_in(result) == {"a", "b"}


def test_files_added_to_a_manifest_survive_every_disk_fault(rounds: Rounds) -> None:
    def prepare(result: Path) -> None:
        lay(result, "a", "b")
        finish(result)
        lay(result, "c")

    def change(result: Path) -> None:
        job.drop_files(result, [result / "b"])
        job.add_files(result, [result / "c"])

    for result in rounds(prepare, change):
        assert names_in(result) in ({"a", "b"}, {"a"}, {"a", "c"})
        change(result)
        assert names_in(result) == {"a", "c"}


def save(folder: Path, step: int) -> None:
    def write(into: Path) -> None:
        (into / "model").write_bytes(bytes([step]) * 100)

    job.CheckpointStore(folder).save({"step": step}, write)


def saved(folder: Path) -> int:
    checkpoint = job.CheckpointStore(folder).latest()
    step = int(str(checkpoint.state["step"]))
    assert (checkpoint.path / "model").read_bytes() == bytes([step]) * 100
    return step


def test_a_checkpoint_survives_every_disk_fault(rounds: Rounds) -> None:
    found = set()
    for folder in rounds(lambda folder: save(folder, 1), lambda folder: save(folder, 2)):
        found.add(saved(folder))
        save(folder, 3)
        assert saved(folder) == 3 and [path.name for path in folder.iterdir()] == ["checkpoint"]
    assert found == {1, 2}


def test_the_first_checkpoint_survives_every_disk_fault(rounds: Rounds) -> None:
    for folder in rounds(lambda folder: None, lambda folder: save(folder, 1)):
        if job.CheckpointStore(folder).latest() is None:
            save(folder, 1)
        assert saved(folder) == 1


@pytest.mark.parametrize("rounds", FAULTS, indirect=True)
def test_reading_a_checkpoint_survives_every_disk_fault(rounds: Rounds) -> None:
    """What the disk does not give now is no reason to advise that it be deleted."""

    def read(folder: Path) -> None:
        try:
            saved(folder)
        except PlgsError as error:
            assert "Delete" not in error.fix or "damaged" not in error.what, error
            raise

    for folder in rounds(lambda folder: save(folder, 1), read):
        assert saved(folder) == 1


def test_the_list_of_recent_lifts_survives_every_disk_fault(rounds: Rounds) -> None:
    for cache in rounds(lambda cache: remember_lift(Path("/a"), cache), lambda cache: remember_lift(Path("/b"), cache)):
        assert remembered_lifts(cache) in (["/a"], ["/b", "/a"])
        remember_lift(Path("/c"), cache)
        assert remembered_lifts(cache)[0] == "/c"


def test_a_new_lift_folder_survives_every_disk_fault(rounds: Rounds) -> None:
    request = job.LiftRequest(scene=Path("/scene"))

    def create(folder: Path) -> None:
        job.LiftFolder.create(folder / "lift", request)

    for folder in rounds(lambda folder: None, create):
        if (folder / "lift" / "request.json").exists():
            assert job.LiftFolder.open(folder / "lift").request == request
        else:
            create(folder)


def bake(folder: Path, views: tuple[str, ...]) -> None:
    """What baking does with a lift folder, without anything to render."""
    result = folder / "result"
    with job.BakeLocks(folder) as locks:
        for view in views:
            with locks.claim(view) as is_ours:
                listed = {str(file.path) for file in job.read_manifest(result).files}
                if is_ours and view not in listed:
                    job.write_atomically(result / view, f"content of {view}")
                    with locks.manifest():
                        job.add_files(result, [result / view])


def test_a_bake_survives_every_disk_fault(rounds: Rounds) -> None:
    def prepare(folder: Path) -> None:
        (folder / "result").mkdir()
        lay(folder / "result", "a")
        finish(folder / "result")

    for folder in rounds(prepare, lambda folder: bake(folder, ("x", "y"))):
        assert names_in(folder / "result") in ({"a"}, {"a", "x"}, {"a", "y"}, {"a", "x", "y"})
        bake(folder, ("x", "y"))
        assert names_in(folder / "result") == {"a", "x", "y"}


@pytest.mark.parametrize("rounds", FAULTS, indirect=True)
def test_a_lift_survives_a_disk_fault(
    rounds: Rounds, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLGS_CACHE_DIR", os.devnull + "/nowhere")

    def run(folder: Path) -> None:
        code = run_engine(job.LiftFolder.open(folder / "lift"), resume=True, lift=tiny_lift)
        said = capfd.readouterr().err
        assert code == job.ExitCode.FINISHED or (said.startswith("error: ") and said.count("\n") == 1), said
        if code == job.ExitCode.FINISHED:
            job.verify(folder / "lift" / "result")

    for folder in rounds(new_lift, run):
        lift = job.LiftFolder.open(folder / "lift")
        assert not lift.is_running
        assert run_engine(lift, resume=True, lift=tiny_lift) is job.ExitCode.FINISHED
        job.verify(lift.result_path)
        capfd.readouterr()


SIZE = 3 << 20
STEPS = 12


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """Mounted for this test. Only root may, and not in every container."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", str(folder)]
    if sys.platform != "linux" or subprocess.run(mount, capture_output=True, timeout=120).returncode != 0:
        pytest.skip("no file system can be mounted here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True, timeout=120)


def fill(disk: Path) -> Path:
    filler = disk / "filler"
    with pytest.raises(OSError), filler.open("wb", buffering=0) as file:
        while True:
            assert file.write(bytes(4096))
    return filler


def lift_until_full(disk: Path, at: int) -> object:
    """A lift of several checkpoints; at a step somebody else takes all room that is left."""

    def lift(folder: job.LiftFolder, events: job.EventWriter, stop: job.StopSignal, *, resume: bool) -> None:
        events.stage("train", 1, 1, "Training")
        checkpoint = folder.checkpoints.latest()
        for step in range(1 + (int(str(checkpoint.state["step"])) if checkpoint else 0), STEPS + 1):
            if step == at:
                fill(disk)
            folder.checkpoints.save({"step": step}, lambda into: (into / "model").write_bytes(bytes(300_000)))
            events.progress("train", step, STEPS)
        if at > STEPS:
            fill(disk)
        tiny_lift(folder, events, stop, resume=resume)

    return lift


@pytest.mark.parametrize("at", [1, 2, 7, STEPS, STEPS + 1])
def test_a_lift_continues_when_there_is_room_again(disk: Path, at: int, capfd: pytest.CaptureFixture[str]) -> None:
    folder = job.LiftFolder.create(disk / "lift", job.LiftRequest(scene=disk))
    code = run_engine(folder, lift=lift_until_full(disk, at))  # type: ignore[arg-type]
    said = capfd.readouterr().err
    assert code == job.ExitCode.INTERNAL_ERROR and said.startswith("error: the disk is full") and said.count("\n") == 1
    assert folder.state() in (job.LiftState.FAILED, job.LiftState.INTERRUPTED)
    assert all(event.kind in ("hello", "stage", "progress", "error") for event in last_events(folder.events_path))
    checkpoint = folder.checkpoints.latest()
    assert (0 if checkpoint is None else checkpoint.state["step"]) == min(at, STEPS + 1) - 1
    (disk / "filler").unlink()
    assert run_engine(folder, resume=True, lift=lift_until_full(disk, 0)) is job.ExitCode.FINISHED  # type: ignore[arg-type]
    assert folder.state() is job.LiftState.FINISHED and job.verify(folder.result_path)
