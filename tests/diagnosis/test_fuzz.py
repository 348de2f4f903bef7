"""Whatever cameras and depth say together, a scene is inspected and diagnosed, or refused by one line."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from engine.diagnosis import diagnose
from engine.errors import PlgsError
from engine.scene import open_scene
from engine.scene.checks import survey_scene
from tests.fuzzing import examples
from tests.tiny_scene import write_tiny_scene

SIZE = (32, 24)
HOLES = ["none", "rows", "columns", "grid", "chequers", "all but one", "border", "half", "all"]
DEPTHS = ["as it is", "flat", "noise", "steps", "far", "near", "one spike"]
POSES = ["as it is", "all one", "one far away", "mirrored", "scaled", "jumping", "no number"]
FOCAL = st.sampled_from([1e-3, 0.1, 1.0, 22.8, 300.0, 3e4, 1e9]) | st.floats(1e-6, 1e6)
CENTRE = st.sampled_from([-1e6, -10.0, 0.0, 16.0, 1e6]) | st.floats(-100.0, 100.0)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "original", frames=5, size=SIZE)


def holed(depth: NDArray[np.uint16], holes: str) -> NDArray[np.uint16]:
    keep = np.zeros(depth.shape, bool)
    y, x = np.indices(depth.shape)
    match holes:
        case "none":
            keep[:] = True
        case "rows":
            keep = y % 2 == 0
        case "columns":
            keep = x % 3 == 0
        case "grid":
            keep = (y % 2 == 0) & (x % 2 == 0)
        case "chequers":
            keep = (y + x) % 2 == 0
        case "all but one":
            keep[5, 7] = True
        case "border":
            keep[0], keep[-1], keep[:, 0] = True, True, True
        case "half":
            keep[:, : SIZE[0] // 2] = True
    return np.where(keep, depth, 0).astype(np.uint16)


def changed(depth: NDArray[np.uint16], how: str, seed: int) -> NDArray[np.uint16]:
    random = np.random.default_rng(seed)
    match how:
        case "flat":
            return np.full_like(depth, 1500)
        case "noise":
            return random.integers(1, 65536, depth.shape).astype(np.uint16)
        case "steps":
            return (depth // 1000 * 1000).astype(np.uint16)
        case "far":
            return np.full_like(depth, 65535)
        case "near":
            return np.ones_like(depth)
        case "one spike":
            depth[3, 4] = 65535
    return depth


def moved(pose: NDArray[np.float64], number: int, how: str) -> NDArray[np.float64]:
    match how:
        case "all one":
            return np.eye(4)
        case "one far away" if number == 2:
            pose[:3, 3] = 9e3
        case "mirrored":
            pose[:3, 0] *= -1.0
        case "scaled":
            pose[:3, 3] *= 1e3
        case "jumping":
            pose[:3, 3] += 5.0 * (number % 2)
        case "no number" if number == 1:
            pose[:] = -np.inf
    return pose


SCENES: dict[str, st.SearchStrategy[Any]] = {
    "lens": st.none() | st.tuples(FOCAL, FOCAL, CENTRE, CENTRE),
    "holes": st.lists(st.sampled_from(HOLES), min_size=5, max_size=5)
    | st.sampled_from(HOLES).map(lambda one: [one] * 5),
    "how": st.sampled_from(DEPTHS),
    "poses": st.sampled_from(POSES),
    "seed": st.integers(0, 1000),
}


def write(
    original: Path, scene: Path, lens: tuple[float, ...] | None, holes: list[str], how: str, poses: str, seed: int
) -> None:
    shutil.rmtree(scene, ignore_errors=True)
    shutil.copytree(original, scene)
    if lens is not None:
        fx, fy, cx, cy = lens
        K = np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        np.savetxt(scene / "intrinsic" / "intrinsic_color.txt", K)
    for number, path in enumerate(sorted((scene / "depth").iterdir())):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.uint16)
        cv2.imwrite(str(path), holed(changed(depth, how, seed + number), holes[number]))
    for number, path in enumerate(sorted((scene / "pose").iterdir())):
        np.savetxt(path, moved(np.loadtxt(path), number, poses))


def survives(original: Path, tmp_path: Path, drawn: dict[str, Any]) -> None:
    write(original, tmp_path / "scene", **drawn)
    try:
        scene = open_scene(tmp_path / "scene")
        survey_scene(scene)
        diagnose(scene)
    except PlgsError as error:
        assert "\n" not in str(error) and error.fix


@examples(4)
@given(drawn=st.fixed_dictionaries(SCENES))
def test_cameras_and_depth_together(original: Path, tmp_path: Path, drawn: dict[str, Any]) -> None:
    survives(original, tmp_path, drawn)


@pytest.mark.slow
@examples(300)
@given(drawn=st.fixed_dictionaries(SCENES))
def test_many_cameras_and_depths_together(original: Path, tmp_path: Path, drawn: dict[str, Any]) -> None:
    survives(original, tmp_path, drawn)


@pytest.mark.parametrize("holes", ["rows", "columns", "grid", "chequers"])
def test_depth_with_holes_is_diagnosed(original: Path, tmp_path: Path, holes: str) -> None:
    write(original, tmp_path / "scene", None, [holes] * 5, "as it is", "as it is", 0)
    scene = open_scene(tmp_path / "scene")
    survey_scene(scene)
    assert diagnose(scene).as_json()
