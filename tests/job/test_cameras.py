"""Files of cameras: what is read, and what is refused with a line that says why."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from engine.errors import PlgsError
from engine.job import read_cameras
from engine.job.cameras import (
    PreviewCamera,
    frame_numbers,
    read_preview_request,
    refuse_equal_names,
    write_cameras,
    write_preview_request,
)
from tests.raises_key import raises_key

POSE = [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
LENS = {"fx": 50, "fy": 51.5, "cx": 40, "cy": 22.5}
GOOD: dict[str, Any] = {"name": "shot.0001", "width": 80, "height": 45, "camera_to_world": POSE, **LENS}


def write(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def test_a_file_of_cameras_is_read(tmp_path: Path) -> None:
    k = [[50, 0, 40], [0, 51.5, 22.5], [0, 0, 1]]
    with_k = {key: value for key, value in GOOD.items() if key not in LENS} | {"K": k, "name": "b", "clip": [0.1, 9]}
    first, second = read_cameras(write(tmp_path / "cameras.json", [GOOD, with_k]))
    assert (first.name, first.near, first.far) == ("shot.0001", 0.0, math.inf)
    assert first.pinhole == second.pinhole and first.pinhole.K[1] == (0.0, 51.5, 22.5)
    assert (second.near, second.far) == (0.1, 9.0)
    assert first.fingerprint != second.fingerprint  # it is clipped
    near_alone = [replace(second, far=math.inf)]
    write_cameras(tmp_path / "near.json", near_alone)
    assert [*read_cameras(tmp_path / "near.json")] == near_alone


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("[", "json-broken"),
        ([], "not-cameras"),
        ({"name": "a"}, "not-cameras"),
        ([GOOD, 3], "camera-not-object"),
        ([{**GOOD, "fov": 50}], "unknown-field fov camera"),
        ([{key: value for key, value in GOOD.items() if key != "width"}], "lacks-field 1.width"),
        ([{key: value for key, value in GOOD.items() if key != "cy"}], "bad-record camera cy"),
        ([{**GOOD, "K": [[50, 0, 40], [0, 51, 22], [0, 0, 1]]}], "bad-record"),
        ([{**GOOD, "fx": 0}], "bad-record focal length"),
        ([{**GOOD, "width": 0}], "wrong-type camera 1.width 16384"),
        ([{**GOOD, "camera_to_world": [[2, 0, 0, 0], *POSE[1:]]}], "bad-record rigid"),
        ([{**GOOD, "camera_to_world": POSE[:3]}], "bad-record rows"),
        ([{**GOOD, "clip": [2, 1]}], "bad-record"),
        ([{**GOOD, "camera_to_world": [[-each for each in POSE[0]], *POSE[1:]]}], "bad-record mirrors"),
        ([{**GOOD, "clip": [True, 1]}], "wrong-type camera 1.clip"),
        ([{**GOOD, "name": "a/b"}], "bad-record"),
        ([{**GOOD, "name": "CON.1"}], "bad-record"),
        ([{**GOOD, "name": ".part-a"}], "bad-record"),
        ([{**GOOD, "name": ""}], "bad-record 100"),
        ([GOOD, {**GOOD, "name": "SHOT.0001"}], "same-name SHOT.0001"),
    ],
)
def test_an_invalid_camera_in_a_camera_file_is_refused(tmp_path: Path, content: object, says: str) -> None:
    path = write(tmp_path / "cameras.json", content)
    with raises_key(f"{says} cameras.json"):
        read_cameras(path)


def test_a_camera_named_like_a_frame_is_refused() -> None:
    with raises_key("camera-is-frame"):
        refuse_equal_names(["b", "A"], Path("cameras.json"), taken=["a"])


SEEN_FROM = ((0.0, 0.0, 1.0, 4.0), (1.0, 0.0, 0.0, 5.0), (0.0, 1.0, 0.0, 6.0), (0.0, 0.0, 0.0, 1.0))
PINHOLE = ((300.0, 0.0, 160.0), (0.0, 310.0, 120.0), (0.0, 0.0, 1.0))
CAMERA = PreviewCamera(SEEN_FROM, PINHOLE, 320, 240)


def test_a_preview_request_is_read_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "preview.json"
    assert read_preview_request(path) is None
    for wanted in ("0004", CAMERA):
        write_preview_request(path, wanted)
        assert read_preview_request(path) == wanted
    assert [each.name for each in tmp_path.iterdir()] == ["preview.json"]


@pytest.mark.parametrize(
    "change",
    [
        {"camera_to_world": None},
        {"camera_to_world": [[1, 0, 0, 0]] * 4},
        {"camera_to_world": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]},
        {"camera_to_world": [[1, 0, 0, 1e999], *([0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1])]},
        {"camera_to_world": [[1, 0, 0, 2e4], *([0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1])]},
        {"K": [[0, 0, 160], [0, 310, 120], [0, 0, 1]]},
        {"K": [[300, 5, 160], [0, 310, 120], [0, 0, 1]]},
        {"K": [["300", 0, 160], [0, 310, 120], [0, 0, 1]]},
        {"width": 0},
        {"height": 1e9},
        {"height": True},
        {"frame": 4, "width": None},
    ],
)
def test_an_invalid_camera_for_the_preview_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    path = tmp_path / "preview.json"
    whole = {"camera_to_world": SEEN_FROM, "K": PINHOLE, "width": 320, "height": 240}
    path.write_text(json.dumps(whole | change))
    with pytest.raises(PlgsError):
        read_preview_request(path)


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("1001", [1001]),
        ("1001,1003", [1001, 1003]),
        ("10-16:2", [10, 12, 14, 16]),
        ("10-16x3, 7", [10, 13, 16, 7]),
        ("0003-0005", [3, 4, 5]),
        ("-3-1", [-3, -2, -1, 0, 1]),
        ("-3--1:2, -7", [-3, -1, -7]),
        ("1001-1002:0.5, 7.25", [1001, 1001.5, 1002, 7.25]),
    ],
)
def test_lists_and_ranges_of_frames_are_parsed(text: str, frames: list[float]) -> None:
    assert [frame / 1000 for each in frame_numbers(text) for frame in each] == frames


@pytest.mark.parametrize("text", ["", "1-", "5-1", "1-5:0", "1-5:0.0001", "a", "1;2", "-3--5", "--3", "1,,2"])
def test_an_invalid_list_of_frames_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="such as|looks like"):
        frame_numbers(text)
