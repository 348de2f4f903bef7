"""Before a lift, from a script: masks and their classes, Diagnose and Fix."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import bpy
import cv2
import numpy as np
import pytest
from plgs.plgs_blender import registry
from plgs.plgs_blender.running.diagnosis import Diagnosis, diagnose, diagnosis_of, leave_out
from plgs.plgs_blender.running.preparation import MaskMaking
from plgs.plgs_blender.settings import chosen_scene
from tiny_scene import write_tiny_scene

from engine.scene import open_scene
from tests.raises_key import raises_key, worded

HAS_TRANSFORMERS = all(importlib.util.find_spec(name) for name in ("torch", "transformers"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path / "room", frames=3, size=(64, 48), ground_truth=False)


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """Without masks."""
    return write_tiny_scene(tmp_path / "room", frames=3, size=(64, 48), ground_truth=False, masks="none")


def test_classes_of_masks_are_read_merged_and_written(folder: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(folder)
    assert bpy.ops.plgs.read_classes() == {"FINISHED"}
    rows = bpy.context.scene.plgs_masks.classes
    assert [(row.name, row.into, row.is_thing) for row in rows][2:4] == [("cabinet", "", True), ("chair", "", True)]
    rows["chair"].into, rows["ceiling"].into, rows["wall"].name = "cabinet", "void", "walls"
    rows["cabinet"].is_thing = False
    assert bpy.ops.plgs.write_classes() == {"FINISHED"}
    classes = open_scene(folder).classes
    assert [(each.name, each.is_thing) for each in classes.categories] == [
        ("walls", False), ("floor", False), ("cabinet", False)
    ]  # fmt: skip
    bpy.ops.plgs.read_classes()
    assert {row.name: row.into for row in bpy.context.scene.plgs_masks.classes} == {
        "walls": "", "floor": "", "cabinet": "", "chair": "cabinet", "ceiling": "void"
    }  # fmt: skip


def test_write_classes_overwrites_no_file_that_the_blend_names(folder: Path, tmp_path: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(folder)
    bpy.ops.plgs.read_classes()
    other = tmp_path / "of_the_user.txt"
    other.write_text("mine")
    bpy.context.scene.plgs_masks.path = str(other)
    with pytest.raises(RuntimeError, match=worded("other-scene")):
        bpy.ops.plgs.write_classes()
    assert other.read_text() == "mine"


def test_write_classes_does_not_replace_a_link(folder: Path, tmp_path: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(folder)
    bpy.ops.plgs.read_classes()
    target = Path(bpy.context.scene.plgs_masks.path)
    target.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RuntimeError, match=worded("not-a-file")):
        bpy.ops.plgs.write_classes()
    assert target.is_symlink()


def test_make_masks_reports_a_missing_model(bare: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(bare)
    with pytest.raises(RuntimeError, match=worded("no-model nowhere")):
        bpy.ops.plgs.make_masks(model="nowhere")
    making, settings = registry.latest(MaskMaking), bpy.context.scene.plgs
    assert making is not None and not making.is_running and making.error is not None
    assert making.error_for(chosen_scene(settings)) == making.error
    settings.scene_folder = str(bare.parent)
    assert making.error_for(chosen_scene(settings)) is None, "another scene has no such error"
    assert not (bare / "panoptic").exists()


@pytest.mark.skipif(not HAS_TRANSFORMERS, reason="needs transformers (requirements/segment.txt)")
def test_make_masks_writes_masks_with_the_networks_classes(bare: Path, tmp_path: Path) -> None:
    from tests.segment.tiny_mask2former import NAMES, save_tiny_mask2former

    bpy.context.scene.plgs.scene_folder = str(bare)
    model = save_tiny_mask2former(tmp_path / "model")
    assert bpy.ops.plgs.make_masks(model=str(model)) == {"FINISHED"}
    assert [each.name for each in open_scene(bare).classes.categories] == NAMES
    making = registry.latest(MaskMaking)
    assert making is not None and making.answer is not None and making.answer["frames"] == 3


@pytest.fixture
def inverted(tmp_path: Path) -> Path:
    """A scene whose poses are world-to-camera."""
    folder = write_tiny_scene(tmp_path / "scene", frames=14, size=(96, 72))
    for path in (folder / "pose").iterdir():
        np.savetxt(path, np.linalg.inv(np.loadtxt(path)))
    return folder


def test_the_diagnose_and_mend_buttons_write_a_mended_scene(inverted: Path) -> None:
    settings = bpy.context.scene.plgs
    assert not bpy.ops.plgs.diagnose.poll() and not bpy.ops.plgs.show_finding.poll()
    settings.scene_folder = str(inverted)
    assert bpy.ops.plgs.diagnose() == {"FINISHED"}
    known = diagnosis_of(chosen_scene(settings))
    assert known is not None and [finding.cause for finding in known.findings] == ["inverted poses"]
    assert known.can_be_mended and known.findings[0].is_mended and "%" in known.findings[0].text
    assert bpy.ops.plgs.show_finding(number=0) == {"FINISHED"}
    assert any(image.name.startswith("PLGS finding") and image.packed_file for image in bpy.data.images)
    count = len(bpy.data.images)
    assert bpy.ops.plgs.show_finding(number=0) == {"FINISHED"} and len(bpy.data.images) == count
    assert bpy.ops.plgs.fix_scene() == {"FINISHED"}
    assert Path(settings.scene_folder) == inverted.with_name("scene_mended")
    assert bpy.ops.plgs.diagnose() == {"FINISHED"}
    again = diagnosis_of(chosen_scene(settings))
    assert again is not None and again.findings == () and again.error is None
    assert not bpy.ops.plgs.fix_scene.poll()


def test_frames_of_a_diagnosis_finding_can_be_visited_and_left_out(tmp_path: Path) -> None:
    """The mask of one frame is upside down: its name leads to its camera, and splits.json leaves it out."""
    folder = write_tiny_scene(tmp_path / "scene", frames=14, size=(96, 72))
    photo = sorted((folder / "color").iterdir())[6]
    mask = folder / "panoptic" / f"{photo.stem}.png"
    cv2.imwrite(str(mask), cv2.imread(str(mask), cv2.IMREAD_UNCHANGED)[::-1, ::-1])
    scene = bpy.context.scene
    scene.plgs.scene_folder = str(folder)
    bpy.ops.plgs.diagnose()
    known = diagnosis_of(chosen_scene(scene.plgs))
    number, finding = next((n, each) for n, each in enumerate(known.findings) if each.cause == "contradicting masks")
    assert finding.frames == finding.leave_out == (photo.stem,)
    with pytest.raises(RuntimeError, match="Import Cameras and Images"):
        bpy.ops.plgs.go_to_finding(number=number, frame=photo.stem)
    assert bpy.ops.plgs.import_scene() == {"FINISHED"}
    assert bpy.ops.plgs.go_to_finding(number=number, frame=photo.stem) == {"FINISHED"}
    assert scene.camera["frame"] == photo.stem
    assert bpy.ops.plgs.leave_out(number=number) == {"FINISHED"}
    split = json.loads((folder / "splits.json").read_text())
    assert photo.stem not in split["train"] + split["test"] and len(split["train"] + split["test"]) == 13
    assert bpy.ops.plgs.leave_out(number=number) == {"CANCELLED"}, "they are left out already"
    assert bpy.ops.plgs.diagnose() == {"FINISHED"}
    again = diagnosis_of(chosen_scene(scene.plgs))
    assert again is not None and again.frames == 13
    assert "contradicting masks" not in [each.cause for each in again.findings]
    mine, other = (replace(finding, leave_out=(name,)) for name in again.split.train[:2])
    (folder / "splits.json").write_text(json.dumps({"train": again.split.train, "test": []}))
    yours = (folder / "splits.json").read_bytes()
    path, kept = leave_out(again, mine)
    assert path == folder / "splits.json" and kept == folder / "splits.before.json" and kept.read_bytes() == yours
    assert leave_out(again, other) == (path, None) and kept.read_bytes() == yours, "what we wrote is not kept"
    path.write_bytes(later := yours + b"\n")
    _, second = leave_out(again, replace(finding, leave_out=()))
    assert second == folder / "splits.before_2.json" and second.read_bytes() == later and kept.read_bytes() == yours
    with raises_key("no-training-frame"):
        leave_out(again, replace(finding, leave_out=(*again.split.train, *again.split.test)))


def test_a_diagnosis_can_be_cancelled(inverted: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(inverted)
    assert not bpy.ops.plgs.cancel_diagnosis.poll()
    diagnosis = diagnose(bpy.context.scene.plgs)
    assert not bpy.ops.plgs.diagnose.poll(), "one at a time"
    assert bpy.ops.plgs.cancel_diagnosis() == {"FINISHED"}
    assert not registry.running(Diagnosis) and bpy.ops.plgs.diagnose.poll()
    assert diagnosis.was_cancelled and diagnosis_of(chosen_scene(bpy.context.scene.plgs)) is None


@pytest.mark.skipif(not HAS_TRANSFORMERS, reason="needs transformers (requirements/segment.txt)")
def test_make_depth_and_set_scale_write_depth_and_its_scale(tmp_path: Path) -> None:
    from tests.depth.test_making import save_tiny_depth_network
    from tests.scene.test_depth import write_colmap

    folder = write_colmap(tmp_path / "room")
    bpy.context.scene.plgs.scene_folder = str(folder)
    model = save_tiny_depth_network(tmp_path / "model")
    assert bpy.ops.plgs.make_depth(model=str(model)) == {"FINISHED"} and open_scene(folder).has_depth
    assert bpy.ops.plgs.set_scale(length=2.0, metres=1.0) == {"FINISHED"}
    assert json.loads((folder / "scale.json").read_text()) == {"scale": 0.5}


@pytest.mark.skipif(not HAS_TRANSFORMERS, reason="needs transformers (requirements/segment.txt)")
def test_a_film_dropped_into_blender_is_prepared_and_lifted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its poses and its depth were made before, so that no COLMAP is needed."""
    from plgs.plgs_blender.running import lifting

    from engine.depth_making import make_depth
    from tests.depth.test_making import quiet, rooms_network
    from tests.doors.test_films import write_film
    from tests.segment.tiny_mask2former import save_tiny_mask2former

    film, begun = write_film(tmp_path), list[str]()
    folder, settings = film.with_suffix(""), bpy.context.scene.plgs
    make_depth(open_scene(folder), folder, rooms_network(), quiet)
    monkeypatch.setattr(lifting, "start_lift", lambda settings: begun.append(settings.scene_folder))
    bpy.context.scene.plgs_masks.model = str(save_tiny_mask2former(tmp_path / "masks"))
    settings.depth = str(tmp_path / "of another scene")
    assert bpy.ops.plgs.import_film(filepath=str(film)) == {"FINISHED"}
    assert begun == [str(folder)] == [settings.scene_folder] and not settings.depth
    assert open_scene(folder).has_masks
    handler = bpy.types.PLGS_FH_film
    assert handler.bl_import_operator == "plgs.import_film" and ".mp4" in handler.bl_file_extensions.split(";")
    assert handler.poll_drop(SimpleNamespace(area=SimpleNamespace(type="VIEW_3D")))
    assert not handler.poll_drop(SimpleNamespace(area=None))


def test_a_dropped_file_that_is_not_a_film_is_reported(tmp_path: Path) -> None:
    (tmp_path / "room.mp4").write_text("no film")
    with pytest.raises(RuntimeError, match="This is not an MP4"):
        bpy.ops.plgs.import_film(filepath=str(tmp_path / "room.mp4"))
    assert not (tmp_path / "room").exists()
