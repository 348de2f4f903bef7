"""Files of cameras: what is read, and what is refused with a line that says why."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from engine.errors import PlgsError
from engine.job import read_cameras
from engine.job.cameras import refuse_equal_names

POSE = [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
LENS = {"fx": 50, "fy": 51.5, "cx": 40, "cy": 22.5}
GOOD: dict[str, Any] = {"name": "shot.0001", "width": 80, "height": 45, "camera_to_world": POSE, **LENS}


def write(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def test_cameras_are_read(tmp_path: Path) -> None:
    k = [[50, 0, 40], [0, 51.5, 22.5], [0, 0, 1]]
    with_k = {key: value for key, value in GOOD.items() if key not in LENS} | {"K": k, "name": "b", "clip": [0.1, 9]}
    first, second = read_cameras(write(tmp_path / "cameras.json", [GOOD, with_k]))
    assert (first.name, first.near, first.far) == ("shot.0001", 0.0, math.inf)
    assert first.pinhole == second.pinhole and first.pinhole.K[1] == (0.0, 51.5, 22.5)
    assert (second.near, second.far) == (0.1, 9.0)
    assert first.fingerprint != second.fingerprint  # it is clipped


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("[", "JSON is cut off or broken"),
        ([], "does not hold a list of cameras"),
        ({"name": "a"}, "does not hold a list of cameras"),
        ([GOOD, 3], "camera 2 is not a JSON object"),
        ([{**GOOD, "fov": 50}], "has 'fov' in camera 1, which this version does not know"),
        ([{key: value for key, value in GOOD.items() if key != "width"}], "has no 'camera 1.width'"),
        ([{key: value for key, value in GOOD.items() if key != "cy"}], "camera 1: has no 'cy'"),
        ([{**GOOD, "K": [[50, 0, 40], [0, 51, 22], [0, 0, 1]]}], "both K and"),
        ([{**GOOD, "fx": 0}], "no focal length"),
        ([{**GOOD, "width": 0}], "'camera 1.width' has to be a whole number from 1 to 16384, not 0"),
        ([{**GOOD, "camera_to_world": [[2, 0, 0, 0], *POSE[1:]]}], "not rigid"),
        ([{**GOOD, "camera_to_world": POSE[:3]}], "4 rows"),
        ([{**GOOD, "clip": [2, 1]}], "near at least 0 and less than far"),
        ([{**GOOD, "clip": [True, 1]}], "'camera 1.clip[0]' has to be a number"),
        ([{**GOOD, "name": "a/b"}], "cannot be the name of a file"),
        ([{**GOOD, "name": "CON.1"}], "cannot be the name of a file"),
        ([{**GOOD, "name": ".part-a"}], "cannot be the name of a file"),
        ([{**GOOD, "name": ""}], "1 to 100 characters"),
        ([GOOD, {**GOOD, "name": "SHOT.0001"}], "two cameras are named 'SHOT.0001'"),
    ],
)
def test_what_is_invalid_is_refused(tmp_path: Path, content: object, says: str) -> None:
    path = write(tmp_path / "cameras.json", content)
    with pytest.raises(PlgsError, match="cameras.json") as error:
        read_cameras(path)
    assert says in str(error.value)


def test_a_frames_name_is_taken() -> None:
    with pytest.raises(PlgsError, match="a frame of the scene is named 'A'"):
        refuse_equal_names(["b", "A"], Path("cameras.json"), taken=["a"])
