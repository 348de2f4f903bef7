"""run_plgs.py --bake camera from outside: a camera of a .blend, a finished lift, and what is refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import run_plgs
from engine.corrections import correct, making
from engine.job import LiftFolder, LiftRequest, verify
from engine.passes.exr import read_exr
from tests.commands import exit_code
from tests.test_run_plgs import run_script
from tests.tiny_scene import tiny_pose, write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as

bpy = pytest.importorskip("bpy")
Matrix = pytest.importorskip("mathutils").Matrix


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lift without passes. Only for reading."""
    root = tmp_path_factory.mktemp("lift")
    scene = write_tiny_scene(root / "room", frames=6, noise=0.1)
    with presets_as(preview=TINY):
        return lift_into(root / "lift", LiftRequest(scene=scene, bake="none")).path


@pytest.fixture
def lift(finished: Path, tmp_path: Path) -> LiftFolder:
    return LiftFolder.open(shutil.copytree(finished, tmp_path / "lift"))


@pytest.fixture(autouse=True)
def this_python_is_the_engines(monkeypatch: pytest.MonkeyPatch, quick_python: Path) -> None:
    monkeypatch.setenv("PLGS_ENGINE_PYTHON", str(quick_python))


@pytest.fixture(scope="module")
def blend(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An artist's file: from frame 1 to 4 the camera "dolly" goes into the room; the active one, "wide", stands."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = 80, 45
    for name in ("dolly", "wide"):
        scene.camera = bpy.data.objects.new(name, bpy.data.cameras.new(name))
        scene.collection.objects.link(scene.camera)
    dolly, pose = bpy.data.objects["dolly"], tiny_pose(1, 6)
    for frame in (1, 4):
        pose[:3, 3] += 0.05 * frame * pose[:3, 2]
        dolly.matrix_world = Matrix((pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist())  # Blender's axes
        dolly.keyframe_insert("location", frame=frame)
    path = tmp_path_factory.mktemp("blend") / "shot.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    return path


@pytest.fixture(scope="module")
def shot(finished: Path, blend: Path, root: Path, tmp_path_factory: pytest.TempPathFactory, quick_python: Path) -> Path:
    """A lift with frames 1 to 3 of "dolly", baked by run_plgs.py. Only for reading."""
    lift = Path(shutil.copytree(finished, tmp_path_factory.mktemp("baked") / "lift"))
    before = blend.read_bytes()
    command = ["-o", lift, "--bake", "camera", "--blend", blend, "--camera", "dolly", "--range", "1-3"]
    first = run_script(root, *command, engine=quick_python)
    assert first.returncode == 0, first.stderr
    assert blend.read_bytes() == before and not (lift / "lift.blend").exists()
    return lift


def test_baking_a_camera_again_keeps_finished_frames(
    shot: Path, blend: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    lift = LiftFolder.open(shutil.copytree(shot, tmp_path / "lift"))
    baked = [lift.passes_path / f"shot_dolly.{frame:04d}.exr" for frame in (1, 2, 3)]
    assert sorted(lift.passes_path.iterdir()) == baked
    written = [path.stat().st_mtime_ns for path in baked]

    command = ["-o", lift.path, "--bake", "camera", "--blend", blend, "--camera", "dolly", "--range", "1-2,4,3"]
    assert exit_code(run_plgs.main, *command, "--progress", "json") == 0
    told = [json.loads(line) for line in capfd.readouterr().out.splitlines() if line.startswith("{")]
    assert told[0]["event"] == "hello" and told[-1]["state"] == "finished"
    assert [path.stat().st_mtime_ns for path in baked] == written
    listed = {file.path.name for file in verify(lift.result_path).files if file.path.suffix == ".exr"}
    assert listed == {*(path.name for path in baked), "shot_dolly.0004.exr"}


def test_camera_passes_can_go_into_another_folder(
    lift: LiftFolder, blend: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = Path(shutil.copytree(lift.request.scene, tmp_path / "moved"))
    command = ["-o", lift.path, "--bake", "camera", "--blend", blend, "--camera", "dolly", "--range", "-1-1", "--scene"]
    before = lift.manifest_path.read_bytes()
    assert exit_code(run_plgs.main, *command, tmp_path / "gone") == 2 and "gone" in capsys.readouterr().err
    assert exit_code(run_plgs.main, *command, moved, "--passes", tmp_path / "mine") == 0
    assert LiftFolder.open(lift.path).request.scene == moved
    assert {path.name for path in (tmp_path / "mine").glob("*.exr")} == {
        f"shot_dolly.{frame}.exr" for frame in ("-0001", "0000", "0001")
    }
    assert lift.manifest_path.read_bytes() == before and not lift.passes_path.exists()
    assert exit_code(run_plgs.main, moved, "-o", lift.path, "--scene", moved) == 2
    assert "--scene belongs to --bake camera without SCENE" in capsys.readouterr().err


def test_a_camera_bake_replaces_only_files_that_plgs_wrote(
    lift: LiftFolder, blend: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "studio.toml").write_text('names = "{shot}_ff"')
    monkeypatch.setenv("PLGS_DEFAULTS", str(tmp_path / "studio.toml"))
    theirs = tmp_path / "shot_ff.0001.exr"
    theirs.write_text("another program's")
    monkeypatch.setattr(run_plgs, "opened_file", lambda: blend)  # as Blender itself runs the script: no --blend
    command = ["-o", lift.path, "--bake", "camera", "--camera", "dolly", "--range", "1"]
    assert exit_code(run_plgs.main, *command, "--passes", tmp_path) == 2
    first, *_, error = capsys.readouterr().err.splitlines()
    assert first == f"From {tmp_path / 'studio.toml'}: names {{shot}}_ff"
    assert error.startswith("error: ") and str(theirs) in error and "--replace" in error
    assert theirs.read_text() == "another program's" and not (tmp_path / ".plgs").exists()
    assert exit_code(run_plgs.main, *command, "--passes", tmp_path, "--replace") == 0
    assert read_exr(theirs).depth.shape == (45, 80)


def test_a_camera_bake_shows_corrections_and_keeps_the_lifts_blend(shot: Path, blend: Path, tmp_path: Path) -> None:
    lift = LiftFolder.open(shutil.copytree(shot, tmp_path / "lift"))
    own = Path(shutil.copy(blend, lift.path / "lift.blend"))
    before = own.read_bytes()
    baked = lift.passes_path / "shot_dolly.0001.exr"
    shown = read_exr(baked).instance
    one = int(shown[shown > 0][0])
    correct(lift.path, lambda state, _: making.delete(state, one, around=False))
    command = ["-o", lift.path, "--bake", "camera", "--blend", blend, "--camera", "dolly", "--range", "1-1"]
    assert exit_code(run_plgs.main, *command) == 2, "what was baked shows no corrections"
    assert exit_code(run_plgs.main, *command, "--replace") == 0
    assert not (read_exr(baked).instance == one).any() and own.read_bytes() == before


def test_baking_a_bad_camera_is_refused(
    lift: LiftFolder, blend: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, cut = tmp_path / "notes.blend", tmp_path / "cut.blend"
    text.write_text("no blend")
    cut.write_bytes(blend.read_bytes()[:100])
    for arguments, told in (
        (["--blend", blend, "--camera", "Nope"], ("no camera named 'Nope'", "'dolly', 'wide'")),
        (["--blend", cut], ("cut.blend", "--blend")),
        (["--blend", text], ("is not a Blender file", "notes.blend", "--blend")),
        (["--blend", tmp_path / "gone.blend"], ("is not there", "gone.blend", "--blend")),
        (["--steps", "5", "--seed", "2"], ("leave out --seed, --steps,", "SCENE")),
        (["--blend", blend, "--range", "1", "--passes", text], ("cannot be written to", "notes.blend")),
        (["--blend", blend, "--range", "1", "--passes", text / "sub"], ("cannot be written to", "notes.blend")),
        (["--range", "3-1"], ("'3-1'", "ends before it begins")),
        (["--range", "-3--5"], ("'-3--5'", "ends before it begins")),
        (["--range", "1;2"], ("'1;2'", "1001,1003")),
        (["--range", "1-999999999"], ("more than 1000000 frames",)),
    ):
        assert exit_code(run_plgs.main, "-o", lift.path, "--bake", "camera", *arguments) == 2
        (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
        assert all(each in line for each in told) and "--save" not in line, line
    assert not lift.passes_path.exists()
