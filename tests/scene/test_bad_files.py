"""Files that are wrong in a known way: a line that says how, or a frame that is left out with its name."""

import json
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from engine.scene import survey_scene
from tests.raises_key import raises_key
from tests.scene.formats.test_record3d import lzfse  # noqa: F401 - a fixture
from tests.scene.mask_formats import test_label_images
from tests.scene.refusing import describe
from tests.scene.samples import Sample, look_into, opened, samples, with_content  # noqa: F401 - a fixture among them

EYE = np.eye(4).tolist()
PICTURE = "images/frame_8"


def changed(path: Path, change: Any) -> AbstractContextManager[None]:
    """The file with a change, for a while: content, a function of it, fields of a JSON object, or None for no file."""
    if callable(change):
        change = change(path.read_bytes())
    elif isinstance(change, dict):
        change = json.dumps(json.loads(path.read_bytes()) | change)
    return with_content(path, change.encode() if isinstance(change, str) else change)


def swapped(old: str, new: str) -> Callable[[bytes], bytes]:
    return lambda data: data.replace(old.encode(), new.encode())


def first(share: float) -> Callable[[bytes], bytes]:
    return lambda data: data[: int(share * len(data))]


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def npy(values: np.ndarray) -> bytes:
    file = BytesIO()
    np.save(file, values, allow_pickle=True)
    return file.getvalue()


def with_arrays(**changes: np.ndarray | None) -> Callable[[bytes], bytes]:
    """An .npz with other arrays, None: without them."""

    def change(data: bytes) -> bytes:
        file = BytesIO()
        with np.load(BytesIO(data)) as stored:
            np.savez(file, **{key: values for key, values in {**stored, **changes}.items() if values is not None})
        return file.getvalue()

    return change


def with_one_id_twice(data: bytes) -> bytes:
    infos = json.loads(data)["segments_info"]
    infos[-1]["id"] = infos[0]["id"]
    return json.dumps(infos).encode()


# Sample, file, what becomes of it (other text; other values of its JSON; nothing), and what the line tells.
BAD: list[tuple[str, str, Any, str]] = [
    ("colmap", "sparse/0/cameras.txt", "3 PINHOLE 128 96 1 2 3\n", "lens-model"),
    ("colmap", "sparse/0/cameras.txt", "3 PINHOLE 128 96 -100 100 64 48", "bad-intrinsics"),
    ("colmap", "sparse/0/cameras.txt", "4 PINHOLE 128 96 100 100 64 48", "no-camera"),
    ("colmap", "sparse/0/cameras.txt", "3 PINHOLE 96 128 100 100 48 48", "other-size 128x96 96x128"),
    ("colmap", "sparse/0/images.txt", "1 1 0 0\n\n", "bad-line"),
    ("colmap", "sparse/0/images.txt", "1 0 0 0 0 0 0 0 3 img_5.png\n\n", "zero-quaternion"),
    ("colmap", "sparse/0/images.txt", "1 1 0 0 0 0 0 0 3 ../img_5.png\n\n", "leaves-folder"),
    ("colmap", "sparse/0/images.txt", "", "model-empty"),
    ("colmap", "sparse/0/points3D.txt", "1 2 3\n", "bad-line"),
    ("colmap", "images/img_5.png", None, "no-pictures img_5.png"),
    *(
        ("colmap-binary", f"sparse/0/{name}.bin", first(share), "cut-off")
        for name in ("cameras", "images", "points3D") for share in (0.0, 0.1, 0.97)
    ),
    ("hypersim", "metadata_camera_parameters.csv", swapped("ai_001_001", "ai_1"), "no-camera"),
    ("hypersim", "metadata_camera_parameters.csv", swapped("0.577", "x"), "bad-camera"),
    ("hypersim", "ai_001_001/_detail/metadata_scene.csv", "parameter_name, parameter_value\n", "no-unit"),
    ("nerfstudio", "transforms.json", {"camera_model": "EQUIRECTANGULAR"}, "lens-model EQUIRECTANGULAR"),
    ("nerfstudio", "transforms.json", {"fl_x": None}, "wrong-type fl_x frame_8"),
    ("nerfstudio", "transforms.json", {"frames": []}, "no-poses"),
    ("nerfstudio", "transforms.json", {"frames": [{"file_path": PICTURE, "transform_matrix": [[1, 2], [3]]}]},
     "wrong-type transform_matrix"),
    ("nerfstudio", "transforms.json", {"frames": [{"file_path": "a.png", "transform_matrix": EYE}]},
     "no-pictures a.png"),
    ("nerfstudio", "transforms.json", {"frames": [{"file_path": "../a.png", "transform_matrix": EYE}]},
     "leaves-folder"),
    ("nerfstudio", "transforms.json", {"frames": [{"file_path": PICTURE, "transform_matrix": [[1] * 4] * 4}]},
     "pose-last-row"),
    ("nerfstudio", "transforms.json", {"ply_file_path": "transforms.json"}, "not-ply"),
    ("polycam", "keyframes/corrected_cameras/98765432107.json", {"t_03": "x"}, "wrong-type t_03"),
    ("record3d", "a.r3d", first(0.5), "not-r3d"),
    ("record3d-unpacked", "metadata", {"poses": [[0, 0, 0, 1, 0, 0, 0]]}, "unequal-counts 11"),
    ("record3d-unpacked", "metadata", {"poses": [[0, 0, 0, 1, 0, 0]] * 11}, "wrong-type poses metadata 11x7"),
    ("record3d-unpacked", "metadata", swapped('"K"', '"k"'), 'lacks-field metadata "K"'),
    ("record3d-unpacked", "metadata", {"perFrameIntrinsicCoeffs": [5] * 11}, "wrong-type coefficients"),
    ("replica", "traj.txt", first(0.7), "wrong-count"),
    ("replica", "traj.txt", ("inf " * 16 + "\n") * 6, "no-poses"),
    ("replica", "cam_params.json", "{}", "lacks-field"),
    ("scannetpp", "iphone/pose_intrinsic_imu.json", {"other": {}}, "not-a-frame other"),
    ("scannetpp", "iphone/pose_intrinsic_imu.json", {"frame_000001": {"aligned_pose": [[1]]}},
     "wrong-type aligned_pose frame_000001 4x4"),
    ("scannetpp", "iphone/pose_intrinsic_imu.json", {"frame_000001": {"aligned_pose": EYE}}, "lacks-field intrinsic"),
    *(("sens", "a.sens", first(share), "cut-off") for share in (0.0, 0.001, 0.01, 0.5, 0.999)),
    ("sens", "a.sens", lambda data: b"\5" + data[1:], "not-sens"),
    ("stray", "odometry.csv", "a, b\n", "no-columns"),
    ("stray", "odometry.csv", lambda data: data + b"1, 2\n", "wrong-count"),
    ("stray", "odometry.csv", swapped("000004", "-4"), "no-frame-number"),
    ("stray", "rgb.mp4", "no video", "not-video"),
    ("tum", "groundtruth.txt", "1.5 2 3\n", "wrong-count"),
    ("tum", "groundtruth.txt", "1.5 a 2 3 0 0 0 1\n", "not-numbers"),
    ("tum", "groundtruth.txt", "1.5 1 2 3 0 0 0 1\n", "no-poses"),
    ("tum", "rgb.txt", "1305031102.17\n", "no-time-stamp"),
    ("tum", "rgb.txt", "1305031102.17 rgb/a.png\n", "unreadable"),
    ("tum", "calibration.txt", "", "intrinsics-incomplete"),
    ("scannet", "gt/instance/0001.png", lambda data: data[:-30] + bytes(10) + data[-20:], "image-damaged"),
    ("panoptic-lifting", "m2f_semantics/0001.png", png(np.full((24, 32), 30, np.uint8)), "unknown-classes 30"),
    ("panoptic-lifting", "m2f_semantics/0001.png", png(np.zeros((24, 32, 3), np.uint8)), "mask-png"),
    ("panoptic-lifting", "m2f_instance/0001.png", png(np.zeros((12, 16), np.uint8)), "other-size 32x24"),
    ("pairs", "masks/semantic/0001.png", png(np.full((48, 64), 2000, np.uint16)), "unknown-classes 2000 0001.png"),
    ("pairs", "masks/instance/0001.png", png(np.zeros((24, 32), np.uint8)), "other-size 64x48"),
    ("arrays", "masks/0001.npy", npy(np.array([{"a": 1}], object)), "pickled"),
    ("arrays", "masks/0001.npy", npy(np.zeros((2, 3, 4, 5))), "shape"),
    ("arrays", "masks/0001.npy", test_label_images.header_of((2**20, 2**20)), "array-too-large"),
    ("arrays", "masks/0001.npy", b"PK\3\4", "not-array"),
    ("detections", "masks/0000.npz", with_arrays(scores=np.array([0.5])), "unequal-counts"),
    ("detections", "masks/0000.npz", with_arrays(scores=None), "no-array"),
    ("detections", "masks/0000.npz", with_arrays(classes=np.array(["chair"], object)), "pickled"),
    ("detections", "masks/0000.npz", with_arrays(masks=np.zeros((48, 64), bool)), "shape"),
    ("detection-pictures", "masks/0001/chair.png", png(np.zeros((48, 64), np.uint8)), "detection-name chair.png"),
    *(
        ("detectron2", "masks/0001.json", text, told) for text, told in (
            ("{", "json-broken"),        ("[3]", "wrong-type"),
            ("{}", "lacks-field segments_info"),        ('[{"id": 1, "isthing": true}]', "lacks-field category_id"),
            ('[{"id": -1, "category_id": 3, "isthing": true}]', "bad-id"),
            ('[{"id": 1, "category_id": 3, "isthing": "yes"}]', "wrong-type isthing"),
        )
    ),
    ("transformers", "masks/0001.json", with_one_id_twice, "segment-twice 0001.json label_ids_to_fuse"),
    ("sam2", "masks/0001.png", png(np.full((48, 64, 3), (9, 8, 7), np.uint8)), "mask-colours"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "file", "change", "told"), BAD)
def test_bad_scene_files_give_one_line_errors(sample: Sample, name: str, file: str, change: Any, told: str) -> None:
    with changed(sample(name) / file, change):
        with raises_key(told) as caught:
            look_into(sample(name), name)
    assert "\n" not in str(caught.value) and caught.value.fix


# Sample, the file of one frame, what becomes of it (None: it is gone), and the frame that is then left out.
LEFT_OUT: list[tuple[str, str, Any, str]] = [
    ("scannet", "depth/0001.png", None, "readable depth is left out: 0001"),
    ("scannet", "panoptic/0001.png", None, "readable mask is left out: 0001"),
    ("scannet", "panoptic.json", swapped('"0001.png"', '"1.png"'), "readable mask is left out: 0001"),
    ("scannet", "pose/0001.txt", None, "pose is left out: 0001"),
    ("nerfstudio", "transforms.json", swapped('"depth/frame_9.png"', "null"), "readable depth is left out: frame_9"),
    ("7scenes", "seq-01/frame-000002.pose.txt", None, "pose is left out: seq-01_frame-000002"),
    ("polycam", "keyframes/depth/98765432107.png", None, "readable depth is left out: 98765432107"),
    ("polycam", "keyframes/corrected_images/98765432107.png", None, "1 of 6 keyframes are not in both"),
    ("stray", "odometry.csv", swapped("000004", "000400"), "readable depth is left out: 000400"),
    ("record3d-unpacked", "rgbd/4.depth", None, "readable depth is left out: 4"),
    ("hypersim", "ai_001_001/images/scene_cam_00_geometry_hdf5/frame.0001.depth_meters.hdf5", None,
     "without depth is left out: cam_00_0001"),
    ("arrays", "masks/0001.npy", b"", "readable mask is left out: 0001"),
    ("detectron2", "masks/0001.json", "", "readable mask is left out: 0001"),
    ("grounded-sam2", "masks/mask_data/mask_0001.npy", None, "readable mask is left out: 0001"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "file", "change", "told"), LEFT_OUT)
def test_a_frame_with_a_missing_file_is_left_out(sample: Sample, name: str, file: str, change: Any, told: str) -> None:
    whole = {frame.name: frame.camera for frame in opened(sample(name), name).frames}
    with changed(sample(name) / file, change):
        scene = opened(sample(name), name)
        assert describe(scene).warnings
    assert any(told in warning for warning in scene.warnings), scene.warnings
    assert len(scene.frames) == len(whole) - 1
    for frame in scene.frames:
        np.testing.assert_array_equal(frame.camera.camera_to_world, whole[frame.name].camera_to_world)
    assert all(frame.read_depth is not None for frame in scene.frames)


# Sample, a file of one frame, what becomes of it, and why that frame is left out when its pixels are read.
UNREADABLE: list[tuple[str, str, Any, str]] = [
    ("hypersim", "ai_001_001/images/scene_cam_00_geometry_hdf5/frame.0001.depth_meters.hdf5", first(0.3),
     "cannot be read"),
    ("record3d", "a.r3d", lambda data: data[:3000] + bytes(20) + data[3020:], "cannot be"),
    ("sens", "a.sens", lambda data: data[:-2000] + bytes(2000), "depth cannot be decompressed|not have the size"),
    ("scannet", "panoptic/0001.png", png(np.zeros((12, 16, 3), np.uint16)), "not an 8-bit RGB PNG"),
    ("arrays", "masks/0001.npy", npy(np.full((48, 64), 1.5)), "not ids"),
    ("arrays", "masks/0001.npy", npy(np.full((5, 48, 64), -1.0, np.float32)), "logits"),
    ("grounded-sam2", "masks/json_data/mask_0000.json", '{"labels": {}}', "objects .*7.* are missing from mask_0000"),
    ("detectron2", "masks/0001.json", '[{"id": 99999, "category_id": 3, "isthing": true}]', "missing from 0001.json"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "file", "change", "told"), UNREADABLE)
def test_a_frame_with_broken_pixels_is_left_out(sample: Sample, name: str, file: str, change: Any, told: str) -> None:
    with changed(sample(name) / file, change):
        scene = opened(sample(name), name)
        survey = survey_scene(scene)
    (gone,) = survey.scene.left_out
    assert {*gone.names} == {frame.name for frame in scene.frames} - {frame.name for frame in survey.scene.frames}
    assert re.search(f"{gone.names[0]}.*{told}", survey.warnings[0])
