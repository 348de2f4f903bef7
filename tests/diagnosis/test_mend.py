"""What a mended scene's folder holds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.command_line.main import main
from engine.diagnosis import diagnose, write_mended
from engine.diagnosis.findings import Diagnosis, Mending
from engine.diagnosis.reprojection import Assumption
from engine.errors import PlgsError
from engine.scene import Scene, open_scene
from tests.raises_key import raises_key
from tests.tiny_scene import write_tiny_scene


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return open_scene(write_tiny_scene(tmp_path / "scene", 6, (64, 48)))


@pytest.fixture
def unproven(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is written is looked at here, though it makes a good scene worse."""
    monkeypatch.setattr("engine.diagnosis.mend.harm_of", lambda *_: None)


def treated(scene: Scene, mending: Mending) -> Diagnosis:
    return Diagnosis((), mending, len(scene.frames), len(scene.frames), None)


@pytest.mark.usefixtures("unproven")
def test_a_mended_scene_differs_only_in_what_was_fixed(scene: Scene, tmp_path: Path) -> None:
    write_mended(scene, treated(scene, Mending(Assumption(unit=2.0), dropped=frozenset({"0002"}))), tmp_path / "out")
    mended = open_scene(tmp_path / "out")
    kept = [frame for frame in scene.frames if frame.name != "0002"]
    assert [(f.name, f.held_out) for f in mended.frames] == [(f.name, f.held_out) for f in kept]
    assert mended.classes == scene.classes
    for new, old in zip(mended.frames, kept, strict=True):
        np.testing.assert_array_equal(new.read_colour(None), old.read_colour(None))
        np.testing.assert_allclose(new.depth(), 2.0 * old.depth(), atol=5.1e-4)
        np.testing.assert_allclose(new.camera.camera_to_world, old.camera.camera_to_world, atol=1e-9)
        np.testing.assert_allclose(new.camera.K, old.camera.K, atol=1e-6)
        np.testing.assert_array_equal(new.mask().ids, old.mask().ids)
        assert new.mask().segments == old.mask().segments
        assert new.read_ground_truth is not None and old.read_ground_truth is not None
        np.testing.assert_array_equal(new.read_ground_truth(None).instance, old.read_ground_truth(None).instance)


@pytest.mark.usefixtures("unproven")
def test_a_mended_depth_shift_moves_depth_by_whole_pixels(scene: Scene, tmp_path: Path) -> None:
    write_mended(scene, treated(scene, Mending(depth_shift=(2 / 64, -1 / 48))), tmp_path / "out")
    old, new = scene.frames[0].depth(), open_scene(tmp_path / "out").frames[0].depth()
    np.testing.assert_array_equal(new[:-1, 2:], old[1:, :-2])
    assert not new[-1].any() and not new[:, :2].any()


@pytest.mark.usefixtures("unproven")
def test_a_mended_scene_keeps_segments_that_may_be_several_objects(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path / "scene", 6, (64, 48), masks="panoptic_lifting")
    for path in (folder / "m2f_instance").iterdir():
        path.write_bytes((folder / "m2f_instance" / "0000.png").read_bytes())
    scene = open_scene(folder)
    write_mended(scene, treated(scene, Mending(Assumption(unit=2.0))), tmp_path / "out")
    old, new = (s.frames[3].mask() for s in (scene, open_scene(tmp_path / "out")))
    assert any(segment.is_group for segment in old.segments)
    assert [(s.class_id, s.is_group) for s in new.segments] == [(s.class_id, s.is_group) for s in old.segments]


def test_mending_into_an_existing_folder_is_refused(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with raises_key("exists"):
        write_mended(scene, treated(scene, Mending(Assumption(unit=2.0))), tmp_path / "out")
    assert main(["inspect", str(scene.folder), "--fix", str(tmp_path / "out")]) == 2


def test_a_mending_that_fails_leaves_no_folder(scene: Scene, tmp_path: Path) -> None:
    scene.frames[4].colour_path.unlink()
    with pytest.raises(PlgsError):
        write_mended(scene, treated(scene, Mending(Assumption(unit=2.0))), tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_inspect_explains_and_mends_a_refused_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Poses so wrong that no two frames see the same surface."""
    folder = write_tiny_scene(tmp_path / "scene", 14, (96, 72))
    for path in (folder / "pose").iterdir():
        pose = np.loadtxt(path)
        pose[:3, 3] += (50.0, -30.0, 0.0)
        np.savetxt(path, np.linalg.inv(pose))
    assert main(["inspect", str(folder)]) == 2
    told = capsys.readouterr()
    assert "wrong: inverted poses: " in told.out and any(line.startswith("error: ") for line in told.err.splitlines())
    assert main(["inspect", str(folder), "--fix", str(tmp_path / "out")]) == 0
    assert main(["inspect", str(tmp_path / "out")]) == 0


def test_a_mended_scene_that_would_be_unusable_is_not_written(scene: Scene, tmp_path: Path) -> None:
    """Depth past 16 bits is lost, and two numbers for a good one make views disagree."""
    known = diagnose(scene)
    for unit, why in ((100.0, "of the depth would be lost"), (1.5, "views would agree")):
        told = replace(known, mending=Mending(Assumption(unit=unit)))
        assert why in (write_mended(scene, told, tmp_path / "out") or "")
        assert [path.name for path in tmp_path.iterdir()] == ["scene"]
