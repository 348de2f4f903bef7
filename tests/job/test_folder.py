"""The lift folder: made once, never taken over, and its state is what happened."""

import errno
import os
import shutil
from contextlib import suppress
from pathlib import Path

import pytest

from engine import job
from engine.command_line.run_engine import run_engine
from engine.errors import PlgsError
from engine.job.atomic import files_below
from tests.job.following import new_lift, tiny_lift
from tests.raises_key import raises_key


def run_tiny(folder: job.LiftFolder) -> None:
    events = job.EventWriter(folder.events_path)
    events.hello(threads=1, resumed=False)
    tiny_lift(folder, events, job.StopSignal(folder.cancel_path), resume=False)
    events.done("finished")
    events.close()


def test_a_created_lift_folder_can_be_opened(tmp_path: Path) -> None:
    folder = new_lift(tmp_path / "deep")
    again = job.LiftFolder.open(folder.path)
    assert again == folder and again.state() is job.LiftState.NOT_STARTED
    assert [path.name for path in folder.path.iterdir()] == ["request.json"]


def test_a_folder_with_other_files_is_refused_for_a_lift(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    before = (folder.path / "request.json").read_bytes()
    with raises_key("holds-lift --resume"):
        job.LiftFolder.create(folder.path, job.LiftRequest(scene=tmp_path, seed=9))
    assert (folder.path / "request.json").read_bytes() == before
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_bytes(b"cat")
    with raises_key("folder-used cat.jpg"):
        new_lift(tmp_path, "photos")
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["cat.jpg"]
    (tmp_path / "file").write_bytes(b"")
    for name in ("file", "file/below"):
        with pytest.raises(PlgsError):
            new_lift(tmp_path, name)


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write everywhere")
def test_a_lift_in_a_read_only_folder_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with raises_key("unwritable"):
        new_lift(tmp_path)


def test_the_state_of_a_lift_follows_its_events_and_result(tmp_path: Path) -> None:
    """A quick look finds the same, without reading the files."""
    folder = new_lift(tmp_path)
    events = job.EventWriter(folder.events_path)

    def state() -> job.LiftState:
        assert folder.state_at_a_glance() is folder.state()
        return folder.state()

    assert state() is job.LiftState.NOT_STARTED
    events.hello(threads=1, resumed=False)
    assert state() is job.LiftState.INTERRUPTED
    events.error(PlgsError("made-up", "broke", "here", "Mend it."))
    assert state() is job.LiftState.FAILED and folder.last_exit_code() == 2
    events.done("cancelled")  # an engine that was asked to stop while it failed
    assert state() is job.LiftState.FAILED
    events = job.EventWriter(folder.events_path)
    events.hello(threads=1, resumed=True)
    assert state() is job.LiftState.INTERRUPTED and folder.last_exit_code() is None
    events.done("cancelled")
    assert state() is job.LiftState.CANCELLED
    with folder.lock():
        assert state() is job.LiftState.RUNNING
    run_tiny(folder)
    assert state() is job.LiftState.FINISHED


def test_a_lift_without_a_complete_result_is_never_finished(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    run_tiny(folder)
    (folder.result_path / "metrics.json").write_text("{")
    assert folder.state() is job.LiftState.INTERRUPTED
    folder.manifest_path.unlink()
    assert folder.state() is job.LiftState.INTERRUPTED


def test_a_new_run_deletes_leftovers_of_an_earlier_run(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    run_tiny(folder)
    folder.checkpoints.save({"step": 1}, lambda path: (path / "m").write_bytes(b""))
    (folder.result_path / "damaged.npz").write_bytes(b"1")
    job.add_files(folder.result_path, [folder.result_path / "damaged.npz"])
    (folder.result_path / "damaged.npz").write_bytes(b"2")
    folder.task_files.ask_to_cancel()
    (folder.result_path / ".part-x.exr").write_bytes(b"")
    folder.prepare_run()
    assert not folder.cancel_path.exists() and not folder.manifest_path.exists() and not folder.is_lifted_again
    assert folder.checkpoints.latest() is not None
    assert [path.name for path in folder.result_path.iterdir()] == ["metrics.json"]


@pytest.mark.parametrize("kept", ["nothing else", "passes", "a file of others"])
def test_lifting_again_keeps_the_old_result_until_the_new_one_is_ready(kept: str, tmp_path: Path) -> None:
    """It can be baked and exported until then, and its passes and others' files are never deleted."""
    folder = new_lift(tmp_path)
    run_tiny(folder)
    before, added = folder.manifest_path.read_bytes(), folder.passes_path / "0001.exr"
    if kept != "nothing else":
        added = added if kept == "passes" else folder.result_path / "grade.blend"
        job.write_atomically(added, b"work")
        if kept == "passes":
            job.add_files(folder.result_path, [added])
            before = folder.manifest_path.read_bytes()
    folder.prepare_run()
    made = folder.with_next_result()
    (made.result_path / "half").write_bytes(b"1")
    assert folder.adopt_next_result() is None and folder.manifest_path.read_bytes() == before and folder.is_whole()
    assert folder.state() is folder.state_at_a_glance() is not job.LiftState.FINISHED
    folder.prepare_run()
    assert [*made.result_path.iterdir()] == []
    (made.result_path / "metrics.json").write_text("{}")
    job.write_manifest(made.result_path, versions={}, seed=1, settings={}, timings={})
    earlier = folder.adopt_next_result()
    assert folder.state() is folder.state_at_a_glance() is job.LiftState.FINISHED and not folder.is_lifted_again
    assert job.read_manifest(folder.result_path).seed == 1 and not added.exists()
    if kept == "nothing else":
        assert earlier is None
    else:
        assert earlier is not None and (earlier / added.relative_to(folder.result_path)).read_bytes() == b"work"


def test_a_lift_cannot_run_again_while_its_passes_are_baked(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    run_tiny(folder)
    with job.BakeLocks(folder.path), raises_key("being-baked"):
        folder.prepare_run()
    assert folder.state() is job.LiftState.FINISHED and not folder.is_lifted_again
    folder.prepare_run()
    with job.BakeLocks(folder.path), raises_key("being-baked"):
        folder.prepare_run()
    assert folder.is_lifted_again, "a lift that was begun is not forgotten"


@pytest.mark.parametrize("spoil", ["empty", "foreign", "truncated", "of another request"])
def test_a_result_is_replaced_only_by_a_whole_one_of_the_same_request(tmp_path: Path, spoil: str) -> None:
    folder, other = new_lift(tmp_path), new_lift(tmp_path, "other", seed=5)
    for each in (folder, other):
        run_tiny(each)
    before = {path: path.read_bytes() for path in files_below(folder.result_path)}
    folder.prepare_run()
    new = folder.with_next_result()
    if spoil == "of another request":
        shutil.rmtree(new.result_path)
        shutil.copytree(other.result_path, new.result_path)
    else:
        (new.result_path / "metrics.json").write_text("{}")
        job.write_manifest(new.result_path, versions={}, seed=1, settings={}, timings={})
        broken = new.result_path / "metrics.json" if spoil == "truncated" else new.manifest_path
        broken.write_text("" if spoil == "truncated" else "{}" if spoil == "empty" else '{"format": 1, "objects": []}')
    for command in ([], ["--resume"]):
        with suppress(PlgsError):
            run_engine(folder, resume=bool(command), lift=failing)
        assert {path: path.read_bytes() for path in files_below(folder.result_path)} == before, command


def failing(*_: object, **__: object) -> None:
    raise PlgsError("no-depth", "has no depth", "room", "Give depth.")


def test_a_kill_while_results_are_swapped_loses_no_result(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    run_tiny(folder)
    folder.prepare_run()
    made = folder.with_next_result().result_path
    (made / "metrics.json").write_text("{}")
    job.write_manifest(made, versions={}, seed=1, settings={}, timings={})
    shutil.rmtree(folder.result_path)
    folder.adopt_next_result()
    assert folder.state() is job.LiftState.FINISHED and job.read_manifest(folder.result_path).seed == 1


def test_a_result_file_on_a_silent_disk_is_not_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = new_lift(tmp_path)
    run_tiny(folder)

    def silent(path: Path) -> str:
        raise OSError(errno.EIO, "Input/output error", str(path))

    monkeypatch.setattr("engine.job.manifest.sha256", silent)
    with pytest.raises(OSError, match="Input/output"):
        folder.prepare_run()
    assert (folder.result_path / "metrics.json").exists() and folder.manifest_path.exists()


def test_discarding_a_lift_folder_deletes_only_lifts_that_never_ran(tmp_path: Path) -> None:
    empty = new_lift(tmp_path, "empty")
    empty.log_path.write_text("bad input")
    empty.discard()
    assert not empty.path.exists()
    done = new_lift(tmp_path, "done")
    run_tiny(done)
    begun = new_lift(tmp_path, "begun")
    begun.checkpoints.save({"step": 1}, lambda path: (path / "m").write_bytes(b""))
    running = new_lift(tmp_path, "running")
    with running.lock():
        for folder in (done, begun, running):
            with raises_key("at-work|finished-work"):
                folder.discard()
            assert (folder.path / "request.json").exists()
    kept = new_lift(tmp_path, "kept")
    (kept.path / "lift.blend").write_bytes(b"somebody's")
    kept.discard()
    assert [path.name for path in kept.path.iterdir()] == ["lift.blend"]


def test_impossible_paths_of_lift_folders_are_refused(tmp_path: Path) -> None:
    request = job.LiftRequest(scene=tmp_path)
    for name in ("a" * 300, "a\0b"):
        with pytest.raises(PlgsError):
            job.LiftFolder.open(tmp_path / name)
        with pytest.raises(PlgsError):
            job.LiftFolder.create(tmp_path / name, request)


def test_a_folder_in_place_of_the_events_is_reported(tmp_path: Path) -> None:
    lift = new_lift(tmp_path)
    lift.events_path.mkdir()
    with raises_key("unopenable events.jsonl"):
        lift.state()
