"""The hand-held twin of a scene: what it degrades, by how much, and what it leaves alone."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from engine.scene import SceneError, check_scene, open_scene
from tests.tiny_scene import write_tiny_scene

SAMPLE = Path(__file__).resolve().parents[2] / "sample"
FRAMES = 12
FOCAL = 110.0
"""Pixels of a depth image 160 wide: about 72 degrees across."""


@pytest.fixture(scope="module")
def programs() -> Iterator[SimpleNamespace]:
    """The sample's programs, which import each other as scripts do."""
    names = ("hand_held", "capture_noise", "depth_sensor", "class_belief")
    path = [*sys.path]
    sys.path.insert(0, str(SAMPLE))
    modules: dict[str, ModuleType] = {name: importlib.import_module(name) for name in names}
    yield SimpleNamespace(**modules, noise=modules["capture_noise"].CaptureNoise())
    sys.path[:] = path
    for name in names:
        del sys.modules[name]


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    splits = {"train": [f"{i:04d}" for i in range(FRAMES - 1)], "test": [f"{FRAMES - 1:04d}"]}
    return write_tiny_scene(tmp_path_factory.mktemp("exact"), frames=FRAMES, size=(160, 120), splits=splits)


@pytest.fixture(scope="module")
def captured(programs: SimpleNamespace, exact: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("captured") / "scene"
    programs.hand_held.write_hand_held(exact, out, seed=0)
    return out


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def random(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def rays(shape: tuple[int, int] = (120, 160)) -> NDArray[np.float64]:
    x, y = (np.arange(shape[1]) + 0.5 - shape[1] / 2) / FOCAL, (np.arange(shape[0]) + 0.5 - shape[0] / 2) / FOCAL
    return np.stack([*np.meshgrid(x, y), np.ones(shape)], -1)


def floor_below(height: float) -> NDArray[np.float64]:
    """Depth of a floor ``height`` metres below a level camera; none above the horizon."""
    down = rays()[..., 1]
    return np.where(down > 0.0, height / np.maximum(down, 1e-6), 0.0)


def test_the_result_is_a_scene_without_warnings(exact: Path, captured: Path) -> None:
    scene, source = open_scene(captured), open_scene(exact)
    assert (*scene.warnings, *check_scene(scene)) == (*source.warnings, *check_scene(source)) == ()
    assert [frame.size for frame in scene.frames] == [(160, 120)] * FRAMES
    assert {frame.read_depth(None).shape for frame in scene.frames} == {(60, 80)}


def test_the_same_seed_gives_the_same_bytes(
    programs: SimpleNamespace, exact: Path, captured: Path, tmp_path: Path
) -> None:
    programs.hand_held.write_hand_held(exact, tmp_path / "again", seed=0)
    programs.hand_held.write_hand_held(exact, tmp_path / "other", seed=1)
    first, again, other = bytes_of(captured), bytes_of(tmp_path / "again"), bytes_of(tmp_path / "other")
    assert first == again
    changed = [name for name in first if name.split("/")[0] in ("color", "depth", "pose")]
    assert len(changed) == 3 * FRAMES and all(first[name] != other[name] for name in changed)


def test_truth_masks_split_and_intrinsics_stay(exact: Path, captured: Path) -> None:
    before, after = bytes_of(exact), bytes_of(captured)
    assert {*after} - {*before} == {"hand_held.json"} and {*before} <= {*after}
    kept = [name for name in before if name.split("/")[0] not in ("color", "depth", "pose")]
    assert {name.split("/")[0] for name in kept} == {"gt", "intrinsic", "panoptic", "panoptic.json", "splits.json"}
    assert [name for name in kept if before[name] != after[name]] == []


def test_poses_are_a_little_wrong_and_rigid(exact: Path, captured: Path) -> None:
    shifts, turns = [], []
    for before, after in zip(open_scene(exact).frames, open_scene(captured).frames, strict=True):
        right, wrong = before.camera.camera_to_world, after.camera.camera_to_world
        assert np.allclose(wrong[:3, :3].T @ wrong[:3, :3], np.eye(3), atol=1e-8)
        shifts.append(np.linalg.norm(wrong[:3, 3] - right[:3, 3]))
        turns.append(np.degrees(np.linalg.norm(cv2.Rodrigues(right[:3, :3].T @ wrong[:3, :3])[0])))
    assert np.sqrt(np.mean(np.square(shifts))) == pytest.approx(0.005, rel=0.01) and max(shifts) < 0.02
    assert np.sqrt(np.mean(np.square(turns))) == pytest.approx(0.3, rel=0.01) and max(turns) < 1.2


@pytest.mark.parametrize("seed", range(3))
def test_poses_drift_rather_than_jump(programs: SimpleNamespace, seed: int) -> None:
    shifts, turns = programs.capture_noise.pose_errors(200, programs.noise, random(seed))
    for errors in (shifts, turns):
        size = np.sqrt((errors**2).sum(-1).mean())
        assert np.linalg.norm(np.diff(errors, axis=0), axis=-1).max() < 0.4 * size
        assert np.allclose(errors.mean(0), 0.0, atol=1e-9)


@pytest.mark.parametrize("count", [1, 6, 200])
def test_gains_stay_within_bounds(programs: SimpleNamespace, count: int) -> None:
    for seed in range(20):
        gains = programs.capture_noise.colour_gains(count, programs.noise, random(seed))
        tints = gains / np.exp(np.log(gains).mean(-1, keepdims=True))
        assert gains.shape == (count, 3) and 0.5 <= gains.min() and gains.max() <= 2.0
        assert np.abs(tints - 1.0).max() < 0.18
        assert np.abs(np.diff(np.log(gains), axis=0)).max(initial=0.0) < 0.3
        if count == 200:
            assert gains.max() / gains.min() > 1.5 and np.abs(tints - 1.0).max() > 0.03


def test_light_is_amplified_and_cut_off(programs: SimpleNamespace) -> None:
    camera, hand_held = programs.capture_noise, programs.hand_held
    assert (camera.srgb(camera.linear(np.arange(256, dtype=np.uint8))) == np.arange(256)).all()
    grey = np.full((8, 8, 3), 0.3, np.float32)
    colour = hand_held.exposed(grey, np.array([1.0, 2.0, 4.0]), None, np.zeros((8, 8), bool))
    assert np.allclose(camera.linear(colour[4, 4]), [0.3, 0.6, 1.0], atol=0.005)


def test_borders_are_black_in_every_frame_and_nowhere_else(
    programs: SimpleNamespace, captured: Path, exact: Path
) -> None:
    pictures = np.stack([frame.read_colour(None) for frame in open_scene(captured).frames])
    black = (pictures == 0).all((0, -1))
    assert (black == programs.capture_noise.border_mask((160, 120), programs.noise, random_border(programs))).all()
    assert (np.stack([frame.read_colour(None) for frame in open_scene(exact).frames]).max((0, -1)) > 0).all()


def test_jpeg_keeps_borders_nearly_black(programs: SimpleNamespace, tmp_path: Path) -> None:
    source = write_tiny_scene(tmp_path / "source", frames=6, size=(320, 240), colour_format="jpg")
    programs.hand_held.write_hand_held(source, tmp_path / "out", seed=0)
    black = programs.capture_noise.border_mask((320, 240), programs.noise, random_border(programs))
    for frame in open_scene(tmp_path / "out").frames:
        assert frame.colour_path.suffix == ".jpg" and frame.read_colour(None)[black].max() <= 16


def random_border(programs: SimpleNamespace) -> np.random.Generator:
    stream: np.random.Generator = programs.class_belief.stream(0, "border")
    return stream


@pytest.mark.parametrize("seed", range(5))
def test_borders_are_thin_and_curved(programs: SimpleNamespace, seed: int) -> None:
    black = programs.capture_noise.border_mask((640, 480), programs.noise, random(seed))
    inner = black[40:-40, 40:-40]
    assert not inner.any()
    for strip in (black[40:-40, :40], black[40:-40, -40:], black[:40, 40:-40].T, black[-40:, 40:-40].T):
        widths = strip.sum(-1)
        assert 6 <= widths.min() and widths.max() <= 16 and widths.max() > widths.min()


def test_a_tenth_of_the_frames_is_blurred(programs: SimpleNamespace) -> None:
    blurred = programs.capture_noise.blurred_frames(70, programs.noise, random())
    lengths = [np.linalg.norm(motion) * 640.0 for motion in blurred.values()]
    assert len(blurred) == 7 and 5.0 <= min(lengths) and max(lengths) <= 11.0


def test_blur_spreads_light_along_the_motion(programs: SimpleNamespace) -> None:
    light = np.zeros((41, 41, 3), np.float32)
    light[20, 20] = 1.0
    blurred = programs.capture_noise.motion_blur(light, np.array([8.0, 0.0]))[..., 0]
    assert blurred.sum() == pytest.approx(1.0, abs=1e-5)
    assert blurred[20].sum() == pytest.approx(1.0, abs=1e-5)
    row = blurred[20]
    across = np.arange(41) - 20.0
    assert (row * across).sum() == pytest.approx(0.0, abs=1e-4)
    assert np.sqrt((row * across**2).sum()) == pytest.approx(8.0 / np.sqrt(12.0), rel=0.08)


def test_depth_noise_grows_with_the_square(programs: SimpleNamespace) -> None:
    sensor, noise = programs.depth_sensor, programs.noise
    for z in (0.8, 2.0, 4.0, 6.0):
        errors = sensor.noisy(np.full((240, 320), z), noise, random()) - z
        expected = 0.0012 + 0.0019 * (z - 0.4) ** 2
        assert errors.std() == pytest.approx(expected, rel=0.1)
        # Neighbours err alike, pixels that are far apart do not.
        near = np.corrcoef(errors[:, 1:].ravel(), errors[:, :-1].ravel())[0, 1]
        far = np.corrcoef(errors[:, 20:].ravel(), errors[:, :-20].ravel())[0, 1]
        assert near > 0.7 and abs(far) < 0.1


def test_depth_steps_grow_with_the_square(programs: SimpleNamespace) -> None:
    depth = np.linspace(0.5, 8.0, 100_000).reshape(100, 1000)
    measured = programs.depth_sensor.quantised(depth, programs.noise)
    levels = np.unique(measured)
    middle, steps = (levels[1:] + levels[:-1]) / 2.0, np.diff(levels)
    assert np.allclose(steps / middle**2, 0.125 / 43.5, rtol=0.01)
    assert (np.abs(measured - depth) < 0.52 * 0.125 / 43.5 * measured**2 + 1e-9).all()


def test_no_depth_stays_none(programs: SimpleNamespace) -> None:
    sensor, noise = programs.depth_sensor, programs.noise
    depth = np.zeros((24, 32))
    for step in (sensor.flying_pixels, sensor.noisy):
        assert (step(depth, noise, random()) == 0.0).all()
    assert (sensor.quantised(depth, noise) == 0.0).all() and (sensor.half_size(depth, noise) == 0.0).all()


def test_half_the_size_shows_the_same_planes(programs: SimpleNamespace) -> None:
    sensor, noise = programs.depth_sensor, programs.noise
    wide = rays((121, 160))
    plane = 1.0 / (0.4 + 0.1 * wide[..., 0] + 0.2 * wide[..., 1])
    half = sensor.half_size(plane, noise)
    assert half.shape == (61, 80)
    middle = wide[:120].reshape(60, 2, 80, 2, 3).mean((1, 3))
    assert np.allclose(half[:60], 1.0 / (0.4 + 0.1 * middle[..., 0] + 0.2 * middle[..., 1]), atol=1e-9)
    step = np.full((4, 8), 3.0)
    step[:, :3] = 1.0
    step[0, 6] = 0.0
    assert np.allclose(sensor.half_size(step, noise), [[1.0, 1.0, 3.0, 3.0]] * 2)


def test_pixels_fly_at_edges_only(programs: SimpleNamespace) -> None:
    sensor, noise = programs.depth_sensor, programs.noise
    step = np.full((120, 160), 3.0)
    step[:, :80] = 1.0
    torn = sensor.flying_pixels(step, noise, random())
    moved = torn != step
    assert not moved[:, :79].any() and not moved[:, 81:].any()
    assert 0.2 < moved[:, 79:81].mean() < 0.6
    assert ((torn[moved] > 1.0) & (torn[moved] < 3.0)).all()
    floor = floor_below(1.5)
    assert (sensor.flying_pixels(floor, noise, random()) == floor).all()


def test_what_swallows_or_mirrors_light_has_no_depth(programs: SimpleNamespace) -> None:
    sensor, noise = programs.depth_sensor, programs.noise
    light = np.full((120, 160, 3), 0.25, np.float32)
    light[10:30, 10:30] = 0.002
    light[60:66, 100:106] = 0.9
    light[90:96, 100:106] = (0.9, 0.1, 0.1)
    dark, shiny = sensor.darkness(light, noise), sensor.highlights(light, noise)
    assert (dark[10:30, 10:30] == 1.0).all() and dark.sum() == 400.0
    assert (shiny[60:66, 100:106] == 1.0).all() and shiny.sum() == 36.0


def test_grazing_and_far_surfaces_have_no_depth(programs: SimpleNamespace) -> None:
    sensor, noise = programs.depth_sensor, programs.noise
    wall = np.full((120, 160), 2.0)
    wall[:, :50] = 1.0
    assert (sensor.slant(wall, rays(), noise) == 0.0).all()  # an edge is not a slant
    floor = floor_below(1.5)
    down = rays()[..., 1] / np.linalg.norm(rays(), axis=-1)  # the cosine, as the floor's normal points up
    slant = sensor.slant(floor, rays(), noise)
    known = np.arange(120)[:, None] > 61 + np.zeros((1, 160))
    assert np.allclose(slant[known], ((0.25 - down[known]) / 0.15).clip(0.0, 1.0), atol=1e-6)
    assert sensor.distance(np.array([3.0, 6.0, 7.0, 8.0, 12.0]), noise).tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]


def test_polished_patches_belong_to_the_world(programs: SimpleNamespace) -> None:
    sensor, noise = programs.depth_sensor, programs.noise
    waves = sensor.polish_waves(noise, random())
    points = random(1).uniform(-20.0, 20.0, (100, 400, 3))
    patches = sensor.polish(points, waves, noise)
    assert 0.01 < patches.mean() < 0.03
    assert (sensor.polish(points[::-1, ::-1], waves, noise)[::-1, ::-1] == patches).all()


@pytest.mark.parametrize("chance", [0.0, 0.1, 0.5, 0.97])
def test_holes_are_as_frequent_as_their_chance(programs: SimpleNamespace, chance: float) -> None:
    found = programs.depth_sensor.holes(np.full((480, 640), chance), programs.noise, random())
    assert found.mean() == pytest.approx(chance, abs=0.04)


def test_depth_with_a_lens_of_its_own_comes_out_on_the_colours(programs: SimpleNamespace, tmp_path: Path) -> None:
    source = write_tiny_scene(tmp_path / "source", frames=6)
    lens = np.loadtxt(source / "intrinsic/intrinsic_color.txt")
    lens[0, 0] *= 1.1
    np.savetxt(source / "intrinsic/intrinsic_depth.txt", lens)
    programs.hand_held.write_hand_held(source, tmp_path / "out", seed=0)
    before, after = open_scene(source).frames[0], open_scene(tmp_path / "out").frames[0]
    read, sensed = before.read_depth((32, 24)), after.read_depth((32, 24))
    known = (read > 0.0) & (sensed > 0.0)
    assert known.mean() > 0.5 and np.median(np.abs(sensed - read)[known]) < 0.03


def test_what_was_done_is_written_down(captured: Path) -> None:
    faults = json.loads((captured / "hand_held.json").read_text())
    assert faults["seed"] == 0 and faults["noise"]["gain"] == 2.0
    assert [frame["frame"] for frame in faults["frames"]] == [f"{i:04d}" for i in range(FRAMES)]
    assert sum(any(frame["blur"]) for frame in faults["frames"]) == 1


@pytest.mark.parametrize("bad", ["exists", "inside", "no scene", "no pose"])
def test_bad_arguments_are_refused_in_one_line(
    programs: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bad: str
) -> None:
    scene, out = write_tiny_scene(tmp_path / "scene", frames=6), tmp_path / "out"
    if bad == "exists":
        out.mkdir()
    if bad == "inside":
        out = scene / "out"
    if bad == "no scene":
        scene = tmp_path / "nothing"
    if bad == "no pose":
        (scene / "pose/0002.txt").unlink()
    monkeypatch.setattr(sys, "argv", ["hand_held.py", str(scene), str(out)])
    with pytest.raises(SystemExit) as refusal:
        programs.hand_held.main()
    assert isinstance(refusal.value.code, str) and "\n" not in refusal.value.code
    assert not (out.exists() and any(out.iterdir()))
    with pytest.raises(SceneError):
        programs.hand_held.write_hand_held(scene, out, seed=0)
