"""Diagnose and Fix, as a script calls them: the engine measures in a process of its own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import bpy
import cv2
import numpy as np
import pytest
from plgs.engine.errors import PlgsError
from plgs.plgs_blender import registry
from plgs.plgs_blender.running.diagnosis import Diagnosis, diagnose, diagnosis_of, leave_out
from plgs.plgs_blender.settings import chosen_scene
from tiny_scene import write_tiny_scene


@pytest.fixture
def inverted(tmp_path: Path) -> Path:
    """A scene whose poses are world-to-camera."""
    folder = write_tiny_scene(tmp_path / "scene", frames=14, size=(96, 72))
    for path in (folder / "pose").iterdir():
        np.savetxt(path, np.linalg.inv(np.loadtxt(path)))
    return folder


def test_a_scene_is_diagnosed_and_mended(inverted: Path) -> None:
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


def test_frames_of_a_finding_are_gone_to_and_left_out(tmp_path: Path) -> None:
    """The photo of one frame is black: its name leads to its camera, and splits.json leaves it out."""
    folder = write_tiny_scene(tmp_path / "scene", frames=14, size=(96, 72))
    photo = sorted((folder / "color").iterdir())[6]
    cv2.imwrite(str(photo), np.zeros((72, 96, 3), np.uint8))
    scene = bpy.context.scene
    scene.plgs.scene_folder = str(folder)
    bpy.ops.plgs.diagnose()
    known = diagnosis_of(chosen_scene(scene.plgs))
    assert known is not None
    number, finding = next((n, each) for n, each in enumerate(known.findings) if each.cause == "exposure")
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
    assert again is not None and again.frames == 13 and "exposure" not in [each.cause for each in again.findings]
    mine, other = (replace(finding, leave_out=(name,)) for name in again.split.train[:2])
    (folder / "splits.json").write_text(json.dumps({"train": again.split.train, "test": []}))
    yours = (folder / "splits.json").read_bytes()
    path, kept = leave_out(again, mine)
    assert path == folder / "splits.json" and kept == folder / "splits.before.json" and kept.read_bytes() == yours
    assert leave_out(again, other) == (path, None) and kept.read_bytes() == yours, "what we wrote is not kept"
    path.write_bytes(later := yours + b"\n")
    _, second = leave_out(again, replace(finding, leave_out=()))
    assert second == folder / "splits.before_2.json" and second.read_bytes() == later and kept.read_bytes() == yours
    with pytest.raises(PlgsError, match="no frame to train on"):
        leave_out(again, replace(finding, leave_out=(*again.split.train, *again.split.test)))


def test_a_measurement_can_be_cancelled(inverted: Path) -> None:
    bpy.context.scene.plgs.scene_folder = str(inverted)
    assert not bpy.ops.plgs.cancel_diagnosis.poll()
    diagnosis = diagnose(bpy.context.scene.plgs)
    assert not bpy.ops.plgs.diagnose.poll(), "one at a time"
    assert bpy.ops.plgs.cancel_diagnosis() == {"FINISHED"}
    assert not registry.running(Diagnosis) and bpy.ops.plgs.diagnose.poll()
    assert diagnosis.was_cancelled and diagnosis_of(chosen_scene(bpy.context.scene.plgs)) is None
