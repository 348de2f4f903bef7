"""A lift as arrays: what its files hold, in plain units, with corrections, also from Pythons that have only NumPy."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import engine
from engine.corrections import correct, making
from engine.job import LiftFolder, LiftRequest, write_manifest
from engine.model.baking import BakedGaussians
from engine.passes.ply import write_splats
from engine.result_files import Anchors, Instance, SemanticPoints, write_arrays, write_instances
from engine.scene import open_scene
from engine.scene_of_lift import remember_scene
from tests.raises_key import raises_key
from tests.tiny_scene import write_tiny_scene

XYZ = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0.5]], np.float32)
IDS = np.array([3, 3, 1], np.int32), np.array([1, 1, 0], np.int32)
SCALES = np.array([[0.01, 0.02, 0.03], [0.1, 0.1, 0.1], [0.5, 0.001, 1]], np.float32)
TURNS = np.array([[1, 0, 0, 0], [0.6, 0, 0, 0.8], [0, 1, 0, 0]], np.float32)


@pytest.fixture
def lift(tmp_path: Path) -> LiftFolder:
    scene = write_tiny_scene(tmp_path / "scene", frames=4, size=(32, 24))
    lift, opened = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene)), open_scene(scene)
    remember_scene(lift, opened)
    lift.result_path.mkdir()
    rgb, ones = np.full((3, 3), 128, np.uint8), np.ones(3, np.float32)
    write_arrays(lift.result_path / "semantic_points.npz", SemanticPoints(XYZ, rgb, *IDS, 0.5 * ones))
    write_arrays(lift.result_path / "anchors.npz", Anchors(XYZ, *IDS, ones, np.zeros(3, np.int32), rgb))
    box = ((0.5, 0.0, 0.0), (1.0, 0.1, 0.1), 0.0, (1.0, 0.0, 0.0, 0.0))
    own = Instance(1, "cabinet 1", 3, "cabinet", (9, 9, 9), *box, views=2, score=0.9, points=2, segments=())
    write_instances(lift.result_path / "instances.json", opened.classes, [own])
    splats = BakedGaussians(XYZ, SCALES, TURNS, np.array([0.1, 0.5, 0.9], np.float32), rgb / np.float32(255), *IDS)
    write_splats(lift.result_path / "gaussians.ply", splats)
    (lift.result_path / "metrics.json").write_text('{"tables": []}')
    return lift


def finish(lift: LiftFolder) -> None:
    write_manifest(lift.result_path, versions={}, seed=0, settings={}, timings={})


def test_a_lift_is_read_as_arrays(lift: LiftFolder) -> None:
    with raises_key("not-finished"):
        engine.read_lift(lift.path)
    finish(lift)
    correct(lift.path, lambda state, free: making.reclass(state, [1], 5))
    correct(lift.path, lambda state, free: making.rename(state, 1, "mine"))
    read = engine.read_lift(str(lift.path))
    assert [(one.name, one.class_id) for one in read.instances] == [("mine", 5)]
    for labelled in (read.points, read.anchors, read.gaussians):
        assert labelled.class_id.tolist() == [5, 5, 1] and labelled.instance_id.tolist() == [1, 1, 0]
        np.testing.assert_array_equal(labelled.xyz, XYZ)
    np.testing.assert_allclose(read.gaussians.scale, SCALES, rtol=1e-5)
    np.testing.assert_allclose(read.gaussians.rotation, TURNS, atol=1e-6)
    np.testing.assert_allclose(read.gaussians.opacity, [0.1, 0.5, 0.9], atol=1e-6)
    np.testing.assert_allclose(read.gaussians.rgb, 128 / 255, atol=1e-6)
    assert {array.dtype.kind for array in vars(read.gaussians).values()} == {"f", "i"}
    assert read.metrics == {"tables": []} and read.frames[0].camera.size == (32, 24)


def test_a_damaged_lift_is_not_read_as_arrays(lift: LiftFolder) -> None:
    finish(lift)
    (lift.result_path / "gaussians.ply").write_bytes(b"ply")
    with raises_key("other-bytes"):
        engine.read_lift(lift.path)


def test_reading_a_lift_as_arrays_needs_only_numpy(root: Path) -> None:
    code = "import sys, engine; engine.read_lift; print({'torch', 'cv2', 'scipy', 'open3d'} & {*sys.modules})"
    run = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "set()"
