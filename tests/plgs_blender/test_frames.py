"""The camera that moves along the frames sees at each of them what the frame's own camera sees."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from plgs.engine.scene import Camera, Frame
from plgs.plgs_blender.cameras import place_camera_path
from plgs.plgs_blender.chosen_scene import ChosenScene
from plgs.plgs_blender.import_scene import place_scene
from plgs.plgs_blender.owned import OwnedDataBlocks
from tiny_scene import write_tiny_scene


def curves(block: bpy.types.ID) -> dict[tuple[str, int], bpy.types.FCurve]:
    """A data-block's animation curves, by path and index."""
    action = block.animation_data.action
    if hasattr(action, "layers"):
        bags = [strip.channelbag(block.animation_data.action_slot) for layer in action.layers for strip in layer.strips]
        return {(curve.data_path, curve.array_index): curve for bag in bags if bag for curve in bag.fcurves}
    return {(curve.data_path, curve.array_index): curve for curve in action.fcurves}


def test_it_is_where_the_frames_are(tmp_path: Path) -> None:
    scene = bpy.context.scene
    root = place_scene(ChosenScene(write_tiny_scene(tmp_path / "room", frames=7)), scene)
    path = next(ob for ob in root.objects if ob.name == "Camera path")
    markers = {marker.camera: marker.frame for marker in scene.timeline_markers}
    assert len(markers) == 7
    for ob, frame in markers.items():
        scene.frame_set(frame)
        assert np.abs(np.array(path.matrix_world) - np.array(ob.matrix_world)).max() < 1e-5
        for name in ("lens", "shift_x", "shift_y", "sensor_width"):
            assert getattr(path.data, name) == pytest.approx(getattr(ob.data, name), abs=1e-6)


def test_it_moves_straight_between_frames_and_its_lens_jumps(tmp_path: Path) -> None:
    root = place_scene(ChosenScene(write_tiny_scene(tmp_path / "room", frames=4)), bpy.context.scene)
    path = next(ob for ob in root.objects if ob.name == "Camera path")
    kinds = {key: {point.interpolation for point in curve.keyframe_points} for key, curve in curves(path).items()}
    assert set(kinds) == {("location", i) for i in range(3)} | {("rotation_quaternion", i) for i in range(4)}
    assert all(each == {"LINEAR"} for each in kinds.values())
    lens = curves(path.data)
    assert set(lens) == {("lens", 0), ("shift_x", 0), ("shift_y", 0)}
    assert all(point.interpolation == "CONSTANT" for curve in lens.values() for point in curve.keyframe_points)


def test_placing_it_again_leaves_no_old_keys(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path / "room", frames=6)
    place_scene(ChosenScene(folder), bpy.context.scene)
    for name in ("color", "depth", "pose"):
        for file in (folder / name).glob("000[45].*"):
            file.unlink()
    root = place_scene(ChosenScene(folder), bpy.context.scene)
    path = next(ob for ob in root.objects if ob.name == "Camera path")
    assert all(len(curve.keyframe_points) == 4 for curve in curves(path).values())
    assert sorted(action.name for action in bpy.data.actions) == ["Camera path lens", "Camera path pose"]


def test_it_never_turns_the_long_way_round() -> None:
    """The quaternions of two cameras that nearly agree may have opposite signs."""
    scene = bpy.context.scene
    owned = OwnedDataBlocks("a lift", scene)
    frames = [frame_turned(angle) for angle in np.radians([150.0, 170.0, 190.0, 210.0])]
    path = place_camera_path(owned, scene.collection, frames, range(1, 1 + len(frames)))
    found = curves(path)
    turns = np.array([[key.co.y for key in found["rotation_quaternion", i].keyframe_points] for i in range(4)]).T
    assert ((turns[1:] * turns[:-1]).sum(axis=1) > 0.9).all()


def frame_turned(angle: float) -> Frame:
    """A frame whose camera is turned about the world's z."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, pose)
    black = np.zeros((48, 64, 3), np.uint8)
    return Frame(f"{angle:.2f}", camera, False, Path("none.png"), None, lambda size: black, None, None)
