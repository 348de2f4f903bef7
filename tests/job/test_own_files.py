"""A lift of somebody else's cannot make an engine write, delete or wait outside of it."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from engine.command_line.run_engine import run_bake, run_engine
from engine.export.run import export
from engine.job import EventReader, EventWriter, LiftFolder, LiftState
from engine.job.atomic import write_atomically
from engine.job.lock import FileLock
from engine.job.own_files import NOTE, OwnFiles
from tests.job.following import new_lift, tiny_lift, watch
from tests.raises_key import raises_key

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no FIFOs here")
NAMES = ["request.json", "events.jsonl", "cancel", "preview.json", "log.txt", "result", "bake", "checkpoint",
         "checkpoint.next", "checkpoint.old", ".part-checkpoint", "result/manifest.json", "result/metrics.json",
         "result/.part-metrics.json", "result.next", "result.next/passes",
         "bake/view-0.lock", "earlier", "earlier/1", "earlier/1/passes", "exports",
         "exports/boxes", "exports/boxes/boxes.csv"]  # fmt: skip


def folder_of_theirs(tmp_path: Path) -> Path:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("content")
    return outside


def link(path: Path, outside: Path) -> None:
    path.symlink_to(outside / "precious" if path.suffix in (".json", ".jsonl", ".txt", ".csv") else outside)


def fifo(path: Path, outside: Path) -> None:
    os.mkfifo(path)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("make", [link, fifo])
def test_links_in_a_lift_change_no_files_outside(name: str, make: Callable[[Path, Path], None], tmp_path: Path) -> None:
    folder, outside = new_lift(tmp_path), folder_of_theirs(tmp_path)
    path = folder.path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    make(path, outside)
    for task in (
        lambda: run_engine(folder, resume=True, lift=tiny_lift),
        lambda: run_bake(folder, ["all"]),
        lambda: export(folder, "boxes", folder.path / "exports" / "boxes", ["all"]),
        folder.discard,
    ):
        with raises_key("foreign-file") as refused:
            task()
        assert refused.value.where == str(path)
    assert [(each.name, each.read_text()) for each in outside.iterdir()] == [("precious", "content")]
    if "/" not in name and not name.startswith(".part"):
        with raises_key("foreign-file"):
            LiftFolder.open(folder.path)


def test_a_users_link_beside_a_lift_does_not_stop_it(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    (folder.path / "lift.blend").symlink_to(tmp_path / "elsewhere.blend")
    assert run_engine(folder, lift=tiny_lift) == 0


WAYS_IN: list[Callable[[Path], object]] = [
    EventWriter,
    lambda path: EventReader(path).poll(),
    lambda path: FileLock(path).__enter__(),
]


@pytest.mark.parametrize("open_it", WAYS_IN)
def test_links_and_fifos_that_appear_later_are_not_opened(open_it: Callable[[Path], object], tmp_path: Path) -> None:
    outside = folder_of_theirs(tmp_path)
    for name, make in (("link", link), ("fifo", fifo)):
        make(tmp_path / name, outside)
        with pytest.raises(OSError):
            open_it(tmp_path / name)


def test_events_cannot_name_files_elsewhere(tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    writer = EventWriter(folder.events_path)
    writer.hello(threads=1, resumed=False)
    for path in ("/etc/passwd", "../x.png", "\\\\host\\share\\x.png", "result/x.png"):
        writer._write("preview", path=path)
    follower = watch(folder)
    follower.poll()
    inside = folder.path / "result" / "x.png"
    assert follower.progress.previews == [inside]


@pytest.mark.parametrize("path", ["../x", "/etc/passwd", "\\\\host\\share\\x", "..\\x", "c:\\x"])
def test_manifests_and_checkpoints_cannot_name_files_elsewhere(path: str, tmp_path: Path) -> None:
    folder = new_lift(tmp_path)
    run_engine(folder, lift=tiny_lift)
    manifest = folder.manifest_path
    manifest.write_text(manifest.read_text().replace("metrics.json", path.replace("\\", "\\\\")))
    assert folder.state() is not LiftState.FINISHED
    folder.checkpoints.save({"step": 1}, lambda into: (into / "model").write_bytes(b"m"))
    state = folder.path / "checkpoint" / "state.json"
    state.write_text(state.read_text().replace('"model"', '"' + path.replace("\\", "\\\\") + '"'))
    with raises_key("bad-field"):
        folder.checkpoints.latest()


@pytest.mark.parametrize(
    "line",
    [
        b"[" * 200_000, b'{"a":' * 5000 + b"1" + b"}" * 5000, b'{"begins": "export"}', b'{"file": "\\ud800/x"}',
        b'{"file": "%s"}' % (b"x" * 5000), b'{"file": "%sb"}' % (b"a/" * 3000), b'{"file": "../precious"}',
        b"\0" * 1000, b"\xff\xfe",
    ],
)  # fmt: skip
def test_forged_lines_in_the_list_of_written_files_delete_nothing(line: bytes, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("content")
    folder = tmp_path / "out"
    for again in (False, True):
        if again:
            with (folder / NOTE).open("ab") as note:
                note.write(line + b"\n")
        with OwnFiles(folder).begin("export", {"of": "it"}) as own:
            for name in ["a"] if again else ["a", "b"]:
                write_atomically(folder / name, name)
            own.remove_earlier()
        own.complete()
    assert sorted(path.name for path in folder.iterdir()) == [NOTE, "a"] and OwnFiles(folder).is_complete
    assert (tmp_path / "precious").exists()


def test_a_folder_that_cannot_be_written_to_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "link").symlink_to("nowhere")
    with raises_key("file-not-folder link nowhere"):
        OwnFiles(tmp_path / "link" / "out").begin("export", {})
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)  # root may write anywhere
    with raises_key("not-writable"):
        OwnFiles(tmp_path / "new" / "out").begin("export", {})


def test_a_huge_list_of_written_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / NOTE).touch()
    os.truncate(tmp_path / NOTE, 2**40)
    with pytest.raises(OSError, match="larger"):
        OwnFiles(tmp_path)
