"""Baking more frames of a finished lift, also by several processes: the very bytes of a lift that bakes them."""

import json
import shutil
import struct
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from engine.command_line.main import main
from engine.command_line.run_engine import run_bake
from engine.corrections import read_corrected
from engine.errors import Cancelled
from engine.job import (
    BakeLocks,
    EventWriter,
    ExitCode,
    LiftFolder,
    LiftRequest,
    LiftState,
    StopSignal,
    read_manifest,
    verify,
)
from engine.job.follower import TaskFollower, start_bake
from engine.job.process import engine_call
from engine.job.task import TaskState
from engine.known_scene import stored_scene, write_known
from engine.lift import bake_frames, bake_more
from engine.lift.bake_more import frames_named
from engine.lift.baking import FrameBaker, names_of_files
from engine.passes.exr import exact_rate, further_layers, read_exr
from engine.posed import Camera, ClassTable, PosedFrame, PosedScene
from engine.posed.exr_header import read_exr_header
from engine.presets.preset import PRESETS
from engine.result_files import Instance
from engine.scene_of_lift import scene_of_lift
from tests.lift.test_lift import files_of
from tests.passes.read_ply import read_ply
from tests.raises_key import raises_key
from tests.tiny_scene import tiny_pose, write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as
from tests.waiting import PATIENCE_S, wait_until


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, LiftFolder]]:
    """The same lift with its held-out frame baked, and with all."""
    root = tmp_path_factory.mktemp("bake")
    scene = write_tiny_scene(root / "scene", frames=6, noise=0.1)
    with presets_as(preview=TINY):
        yield {bake: lift_into(root / bake, LiftRequest(scene=scene, bake=bake)) for bake in ("test", "all")}  # type: ignore[arg-type]


@pytest.fixture
def lift(finished: dict[str, LiftFolder], tmp_path: Path) -> LiftFolder:
    return LiftFolder.open(shutil.copytree(finished["test"].path, tmp_path / "lift"))


def bake(folder: LiftFolder, *frames: str) -> None:
    events = EventWriter(folder.events_path)
    try:
        bake_frames(folder, frames, events, StopSignal(folder.cancel_path))
    finally:
        events.close()


def an_object_in(folder: LiftFolder, frame: str) -> Instance:
    """One that the passes of a frame show."""
    shown = np.unique(read_exr(folder.passes_path / f"{frame}.exr").instance)
    return next(each for each in read_corrected(folder.path).instances if each.id in shown)


def test_frames_baked_later_have_the_same_bytes(finished: dict[str, LiftFolder], lift: LiftFolder) -> None:
    before = json.loads(lift.manifest_path.read_text())
    bake(lift, "0002", "test")
    assert {path.stem for path in lift.passes_path.iterdir()} == {"0002", "0004"}
    times = {path: path.stat().st_mtime_ns for path in lift.result_path.rglob("*.*") if path != lift.manifest_path}
    bake(lift, "all")
    assert files_of(lift) == files_of(finished["all"])
    assert [*files_of(lift)] == [*files_of(finished["all"])]
    assert all(path.stat().st_mtime_ns == time for path, time in times.items())  # what was there was left alone
    after = json.loads(lift.manifest_path.read_text())
    assert after | {"files": 0} == before | {"files": 0}


@pytest.mark.parametrize(
    ("frames", "files"),
    [
        (["3", "12", "left"], ["0003", "0012", "left"]),
        (["9", "12345"], ["00009", "12345"]),
        (["frame_3.colour", "frame_4"], ["frame_3.colour", "frame_0004"]),
        (["000001", "000012"], ["000001", "000012"]),
        (["1305031102.17", "1305031103.2"], ["1305031102.17", "1305031103.2"]),  # seconds
        (["3", "0003"], ["3", "0003"]),
    ],
)
def test_camera_numbers_in_pass_file_names_are_padded(frames: list[str], files: list[str], tmp_path: Path) -> None:
    lift = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path))
    assert names_of_files(lift) == {}
    camera = Camera(4, 3, 4.0, 4.0, 2.0, 1.5, np.eye(4))
    posed = tuple(PosedFrame(name, camera, False, tmp_path / "a.png", None) for name in frames)
    write_known(lift, stored_scene(PosedScene(tmp_path, posed, ClassTable(())), posed))
    assert [*names_of_files(lift).values()] == files


def test_a_bake_reports_the_events_of_an_engine_run(lift: LiftFolder, capfd: pytest.CaptureFixture[str]) -> None:
    lift.task_files.ask_to_cancel()  # an old one
    seq = len(lift.events_path.read_bytes().splitlines())
    assert run_bake(lift, ["0000"]) is ExitCode.FINISHED
    told = [json.loads(line) for line in lift.events_path.read_bytes().splitlines()[seq:]]
    assert [each["event"] for each in told if each["event"] != "progress"] == [
        "hello", "stage", "stage", "artifact", "preview", "done"
    ]  # fmt: skip
    assert told[0]["task"] == "bake" and told[-1]["state"] == "finished"
    assert [each["step"] for each in told if each["event"] == "progress"] == [1]
    assert lift.state() is LiftState.FINISHED
    assert run_bake(lift, ["no such frame"]) is ExitCode.BAD_INPUT
    assert "no frame no such frame" in capfd.readouterr().err
    assert lift.state() is LiftState.FINISHED and lift.last_exit_code() == ExitCode.BAD_INPUT


def test_only_a_finished_lift_can_be_baked(lift: LiftFolder) -> None:
    with lift.lock(), raises_key("at-work"):
        run_bake(lift, ["all"], parent_pipe=0)  # whoever follows it would see the other one's events
    lift.manifest_path.unlink()
    with lift.lock(), raises_key("at-work"):
        run_bake(lift, ["all"])
    with raises_key("not-finished"):
        run_bake(lift, ["all"])


@pytest.mark.parametrize("failure", [Cancelled("asked to"), OSError(28, "No space left on device")])
def test_a_stopped_bake_keeps_the_result(lift: LiftFolder, failure: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    render, rendered = FrameBaker.render, []

    def render_three(self: FrameBaker, *arguments: Any) -> object:
        verify(lift.result_path)
        rendered.append(arguments)
        if len(rendered) == 3:
            raise failure
        return render(self, *arguments)

    monkeypatch.setattr(FrameBaker, "render", render_three)
    with pytest.raises(type(failure)):
        bake(lift, "all")
    names = {file.path.stem for file in verify(lift.result_path).files if file.path.suffix == ".exr"}
    assert names == {"0000", "0001", "0004"} and lift.state() is LiftState.FINISHED


def write_cameras(path: Path, names: list[str], shift: float = 0.0) -> Path:
    """Cameras that no frame has, wider than the frames."""
    pose = tiny_pose(1, 6)
    pose[2, 3] += shift
    lens = {"fx": 50.0, "fy": 52.0, "cx": 40.5, "cy": 22.0, "width": 80, "height": 45}
    path.write_text(json.dumps([{"name": name, "camera_to_world": pose.tolist(), **lens} for name in names]))
    return path


def test_any_camera_can_be_baked(lift: LiftFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = write_cameras(tmp_path / "cameras.json", ["shot.0001", "shot.0002"])
    assert run_bake(lift, None, cameras=cameras) is ExitCode.FINISHED
    exr = lift.passes_path / "shot.0001.exr"
    layers = read_exr(exr)
    assert layers.depth.shape == (45, 80) and (layers.depth > 0).mean() > 0.5
    one, other = (exr.with_name(f"shot.000{number}.exr").read_bytes() for number in (1, 2))
    assert sum(a != b for a, b in zip(one, other, strict=True)) == 1  # the same camera: only the frame's number differs
    listed = {str(file.path) for file in verify(lift.result_path).files}
    assert {"passes/shot.0001.exr", "previews/shot.0001_colour.png", "previews/shot.0002_instance.png"} <= listed
    times = exr.stat().st_mtime_ns
    assert run_bake(lift, None, cameras=cameras) is ExitCode.FINISHED
    assert exr.stat().st_mtime_ns == times  # what is done is kept
    assert run_bake(lift, None, cameras=write_cameras(cameras, ["shot.0001"], shift=0.2)) is ExitCode.FINISHED
    assert np.abs(read_exr(exr).depth - layers.depth).max() > 0.01  # the camera has moved
    verify(lift.result_path)


def test_a_view_at_another_frame_rate_is_baked_again(lift: LiftFolder, tmp_path: Path) -> None:
    cameras, output = write_cameras(tmp_path / "cameras.json", ["shot"]), tmp_path / "shot"
    for more in ({"frame": 1, "fps": 24.0}, {"frame": 1, "fps": 23.976}, {"frame": 5, "fps": 23.976}):
        content = json.loads(cameras.read_text())
        cameras.write_text(json.dumps([content[0] | more]))
        for folder in (None, output):
            assert run_bake(lift, None, cameras=cameras, output=folder, replace=True) is ExitCode.FINISHED
            header = read_exr_header((folder or lift.passes_path) / "shot.exr").attributes
            assert header[b"imageCounter"] == (b"int", struct.pack("<i", more["frame"]))
            assert Fraction(*struct.unpack("<iI", header[b"framesPerSecond"][1])) == exact_rate(more["fps"])


def test_baking_into_another_folder_leaves_the_lift_alone(lift: LiftFolder, tmp_path: Path) -> None:
    before, output = files_of(lift), tmp_path / "shot" / "passes"
    assert run_bake(lift, ["0000"], layers=["normal"], output=output) is ExitCode.FINISHED
    assert files_of(lift) == before and [path.name for path in output.iterdir()] == ["0000.exr"]
    assert further_layers(output / "0000.exr") == {"normal"}
    times = (output / "0000.exr").stat().st_mtime_ns
    assert run_bake(lift, ["0000"], output=output) is ExitCode.FINISHED  # it has all that is wanted
    assert (output / "0000.exr").stat().st_mtime_ns == times
    assert run_bake(lift, ["0000"], output=lift.passes_path) is ExitCode.BAD_INPUT
    assert run_bake(lift, ["0000"], layers=["normal"]) is ExitCode.FINISHED  # the same, but in the result
    assert read_exr(lift.passes_path / "0000.exr").depth.tobytes() == read_exr(output / "0000.exr").depth.tobytes()
    assert run_bake(lift, ["0000"], layers=["position"]) is ExitCode.FINISHED
    assert further_layers(lift.passes_path / "0000.exr") == {"position"}
    assert run_bake(lift, ["0000"], layers=["vector"], output=output) is ExitCode.FINISHED
    assert further_layers(output / "0000.exr") == {"normal", "vector"}, "what was published is kept"
    nuke = {"layers": ["vector"], "output": output, "channels": "nuke"}
    assert run_bake(lift, ["0000"], **nuke) is ExitCode.BAD_INPUT
    assert run_bake(lift, ["0000"], **nuke, replace=True) is ExitCode.FINISHED
    times = (output / "0000.exr").stat().st_mtime_ns
    assert {"depth.Z", "forward.u", "R"} < {*read_exr_header(output / "0000.exr").channels}
    assert run_bake(lift, ["0000"], layers=["vector"], output=output, channels="nuke") is ExitCode.FINISHED
    assert (output / "0000.exr").stat().st_mtime_ns == times  # it has all that is wanted
    assert main(["bake", str(lift.path), "--channels", "nuke"]) == 2
    verify(lift.result_path)


def test_a_folder_in_place_of_a_pass_file_is_reported(lift: LiftFolder, capfd: pytest.CaptureFixture[str]) -> None:
    (lift.passes_path / "0000.exr").mkdir()
    assert run_bake(lift, ["0000"]) is ExitCode.BAD_INPUT
    told = capfd.readouterr().err
    assert str(lift.passes_path / "0000.exr") in told and ".part" not in told


def test_passes_baked_into_another_folder_show_the_corrections(lift: LiftFolder, tmp_path: Path) -> None:
    shown, one = read_exr(lift.passes_path / "0004.exr").instance, an_object_in(lift, "0004")
    assert main(["correct", str(lift.path), "delete", str(one.id), "--no-object"]) == 0
    before, output = files_of(lift), tmp_path / "passes"
    assert run_bake(lift, ["0004"], output=output) is ExitCode.FINISHED
    layers = read_exr(output / "0004.exr")
    assert not (layers.instance == one.id).any() and files_of(lift) == before
    assert (layers.semantic[shown == one.id] == one.class_id).mean() > 0.9
    assert main(["correct", str(lift.path), "undo"]) == 0
    assert run_bake(lift, ["0004"], output=output) is ExitCode.BAD_INPUT, "it shows what was undone"
    assert run_bake(lift, ["0004"], output=output, replace=True) is ExitCode.FINISHED
    assert (read_exr(output / "0004.exr").instance == shown).all()


def test_a_baked_camera_cannot_have_a_frames_name(
    lift: LiftFolder, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    cameras = write_cameras(tmp_path / "cameras.json", ["shot", "0000"])
    assert run_bake(lift, None, cameras=cameras) is ExitCode.BAD_INPUT
    assert "a frame of the scene is named '0000'" in capfd.readouterr().err
    assert not (lift.passes_path / "shot.exr").exists()


def test_two_processes_can_bake_one_lift(lift: LiftFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = lift.events_path.read_bytes()
    view = FrameBaker.render

    def render(self: FrameBaker, *arguments: Any) -> object:
        (lift.passes_path / ".part-another.exr").touch()  # which must not be cleared away
        assert any((lift.path / "bake").glob("process-*.lock"))
        return view(self, *arguments)

    monkeypatch.setattr(FrameBaker, "render", render)
    with lift.lock(), BakeLocks(lift.path) as others, others.claim("0001") as is_ours:
        assert is_ours
        assert run_bake(lift, ["0000"]) is ExitCode.FINISHED
    assert lift.events_path.read_bytes() == seen
    assert {path.stem for path in lift.passes_path.glob("[0-9]*.exr")} == {"0000", "0004"}
    assert (lift.passes_path / ".part-another.exr").exists()
    assert not [*lift.path.glob("bake-*"), *(lift.path / "bake").glob("process-*")]
    verify(lift.result_path)


def test_a_bake_is_refused_if_the_manifest_lacks_its_label_setting(lift: LiftFolder) -> None:
    manifest = json.loads(lift.manifest_path.read_text())
    del manifest["settings"]["one_class_an_object"]
    lift.manifest_path.write_text(json.dumps(manifest))
    with raises_key("kind-missing"):
        bake(lift, "0002")


def test_objects_without_classes_have_the_same_mattes_in_a_later_bake(
    finished: dict[str, LiftFolder], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PRESETS, "preview", TINY)
    options = {"objects": "none", "linear_assignment": True, "labels": "decoders", "one_class_an_object": False}
    request = LiftRequest(scene=finished["test"].request.scene, bake="test", options=options)
    lift = lift_into(tmp_path / "lift", request)
    bake(lift, "0002")
    first, later = (matte_names_of(lift.passes_path / f"{frame}.exr") for frame in ("0004", "0002"))
    assert first == later and all(name.startswith("object ") for name in later)


def matte_names_of(path: Path) -> list[str]:
    with OpenEXR.File(str(path), header_only=True) as file:
        header = dict(file.header())
    layers = {key.split("/")[1] for key, value in header.items() if key.endswith("/name") and "Instance" in str(value)}
    return sorted(json.loads(header[f"cryptomatte/{layers.pop()}/manifest"]))


def test_corrections_reach_every_output(lift: LiftFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    passes, before = lift.passes_path / "0004.exr", read_exr(lift.passes_path / "0004.exr")
    bytes_before = passes.read_bytes()
    one = an_object_in(lift, "0004")
    classes = read_corrected(lift.path).classes
    other = next(kind for kind in classes.categories if kind.is_thing and kind.id != one.class_id)
    commands: list[list[object]] = [["rename", one.id, "The one"], ["reclass", one.id, other.name]]
    for command in commands:
        assert main(["correct", str(lift.path), *map(str, command)]) == 0
    bake(lift, "test")
    verify(lift.result_path)
    after = read_exr(passes)
    shown = after.instance == one.id
    assert shown.any() and (after.semantic[shown] == other.id).all()
    assert ((after.instance == one.id) == (before.instance == one.id)).mean() > 0.99
    with OpenEXR.File(str(passes), header_only=True) as file:
        manifests = [value for name, value in file.header().items() if name.endswith("/manifest")]
    assert any("The one" in str(manifest) for manifest in manifests)
    for form in ("boxes", "splats"):
        assert main(["export", str(lift.path), "--to", form, "-o", str(tmp_path / form)]) == 0
    boxes = json.loads((tmp_path / "boxes" / "boxes.json").read_text())["boxes"]
    assert [box["class_name"] for box in boxes if box["name"] == "The one"] == [other.name]
    splats = read_ply(tmp_path / "splats" / "splats.ply")
    assert (splats.class_id[splats.instance_id == one.id] == other.id).all()
    capsys.readouterr()
    assert main(["evaluate", str(lift.path), "--json"]) == 0
    scored = json.loads(capsys.readouterr().out)
    assert scored != json.loads((lift.result_path / "metrics.json").read_text())
    for _ in commands:
        assert main(["correct", str(lift.path), "undo"]) == 0
    bake(lift, "test")
    assert passes.read_bytes() == bytes_before


def test_frame_ranges_refer_to_the_last_number_in_frame_names(finished: dict[str, LiftFolder], tmp_path: Path) -> None:
    scene = scene_of_lift(finished["test"])
    assert [frame.name for frame in frames_named(scene, ["1-4:2", "0000"])] == ["0000", "0001", "0003"]
    renamed = replace(scene, frames=tuple(replace(each, name=f"cam2_{each.name}.colour") for each in scene.frames))
    assert [frame.name for frame in frames_named(renamed, ["3-9"])] == [f"cam2_000{n}.colour" for n in (3, 4, 5)]
    for wrong in ("7-9", "4-1", "1-4:0", "1-"):
        with raises_key(f"no-frame {wrong}"):
            frames_named(scene, [wrong])


def test_a_frame_may_be_named_all_or_test(finished: dict[str, LiftFolder]) -> None:
    """It took the group's place: of a scene with a photo all.png, nothing else was baked or exported."""
    scene = scene_of_lift(finished["test"])
    names = {"0001": "all", "0002": "test"}
    renamed = replace(scene, frames=tuple(replace(each, name=names.get(each.name, each.name)) for each in scene.frames))
    assert frames_named(renamed, ["all"]) == [*renamed.frames]
    assert [frame.name for frame in frames_named(renamed, ["test"])] == ["test", "0004"]


def test_a_bake_waits_for_views_that_another_process_bakes(lift: LiftFolder) -> None:
    """A view that another process has taken is waited for, and baked here when that process ends without it."""
    with ThreadPoolExecutor(1) as pool:
        with BakeLocks(lift.path) as other, other.claim("0001") as is_ours:
            assert is_ours
            run = pool.submit(bake, lift, "0001", "0002")
            while "0002.exr" not in {file.path.name for file in read_manifest(lift.result_path).files}:
                with pytest.raises(TimeoutError):
                    run.result(0.05)
            with pytest.raises(TimeoutError):
                run.result(3 * bake_more.WAIT_S)
            assert not (lift.passes_path / "0001.exr").exists()
        run.result()
    assert "0001.exr" in {file.path.name for file in verify(lift.result_path).files}


@pytest.fixture
def followers() -> Iterator[list[TaskFollower]]:
    """Those of the test, ended with it."""
    started: list[TaskFollower] = []
    yield started
    for follower in started:
        follower.kill()
        follower.close()


def test_two_bakes_finish_while_a_third_is_cancelled(
    lift: LiftFolder, followers: list[TaskFollower], tmp_path: Path, quick_python: Path
) -> None:
    """Two bake their views to the end, though a third is cancelled beside them."""
    names = {}
    for name, count in (("left", 40), ("right", 12), ("cancelled", 40)):
        names[name] = {f"{name}.{number:04d}" for number in range(count)}
        cameras = write_cameras(tmp_path / f"{name}.json", sorted(names[name]))
        followers.append(follower := start_bake(lift, quick_python, cameras=cameras))
        wait_until(lambda: follower.poll() or not follower.is_running)  # noqa: B023 - it holds the lock, or has told
        assert follower.is_running
    left, right, cancelled = followers
    cancelled.cancel()
    wait_until(lambda: not any([each.poll() or each.is_running for each in followers]))
    assert (left.error, right.error) == (None, None)
    assert [each.state for each in followers] == [TaskState.FINISHED, TaskState.FINISHED, TaskState.CANCELLED]
    for follower in followers:
        follower.close()
    baked = {file.path.stem for file in verify(lift.result_path).files if file.path.suffix == ".exr"}
    assert baked - names["cancelled"] == {"0004"} | names["left"] | names["right"]
    assert not names["cancelled"] <= baked
    assert not [path for path in (lift.path / "bake").iterdir() if not path.name.startswith(("view-", "manifest"))]
    assert not [*lift.path.glob("bake-*"), *lift.path.rglob(".part-*")]


def test_two_bake_commands_share_the_frames(lift: LiftFolder, root: Path, quick_python: Path) -> None:
    command = [*engine_call(quick_python), "bake", lift.path]
    processes = [subprocess.Popen([*map(str, command)], cwd=root, stdout=subprocess.DEVNULL) for _ in range(2)]
    try:
        assert [process.wait(PATIENCE_S) for process in processes] == [0, 0]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    files = [file.path.name for file in verify(lift.result_path).files if file.path.suffix == ".exr"]
    assert files == [f"{number:04d}.exr" for number in range(6)]
