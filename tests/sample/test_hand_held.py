"""The hand-held twin of a scene: what it degrades, by how much, and what it leaves alone."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import capture_noise
import class_belief
import cv2
import depth_sensor
import hand_held
import numpy as np
import pytest
from numpy.typing import NDArray

from engine.errors import PlgsError
from engine.scene import check_scene, open_scene
from tests.tiny_scene import write_tiny_scene

FRAMES = 12
NOISE = capture_noise.CaptureNoise()
FOCAL = 110.0
"""Pixels of a depth image 160 wide: about 72 degrees across."""


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    splits = {"train": [f"{i:04d}" for i in range(FRAMES - 1)], "test": [f"{FRAMES - 1:04d}"]}
    return write_tiny_scene(tmp_path_factory.mktemp("exact"), frames=FRAMES, size=(160, 120), splits=splits)


@pytest.fixture(scope="module")
def captured(exact: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("captured") / "scene"
    hand_held.write_hand_held(exact, out, seed=0)
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


def test_the_same_seed_gives_the_same_bytes(exact: Path, captured: Path, tmp_path: Path) -> None:
    hand_held.write_hand_held(exact, tmp_path / "again", seed=0)
    hand_held.write_hand_held(exact, tmp_path / "other", seed=1)
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
def test_poses_drift_rather_than_jump(seed: int) -> None:
    shifts, turns = capture_noise.pose_errors(200, NOISE, random(seed))
    for errors in (shifts, turns):
        size = np.sqrt((errors**2).sum(-1).mean())
        assert np.linalg.norm(np.diff(errors, axis=0), axis=-1).max() < 0.4 * size
        assert np.allclose(errors.mean(0), 0.0, atol=1e-9)


@pytest.mark.parametrize("count", [1, 6, 200])
def test_gains_stay_within_bounds(count: int) -> None:
    for seed in range(20):
        gains = capture_noise.colour_gains(count, NOISE, random(seed))
        tints = gains / np.exp(np.log(gains).mean(-1, keepdims=True))
        assert gains.shape == (count, 3) and 0.5 <= gains.min() and gains.max() <= 2.0
        assert np.abs(tints - 1.0).max() < 0.18
        assert np.abs(np.diff(np.log(gains), axis=0)).max(initial=0.0) < 0.3
        if count == 200:
            assert gains.max() / gains.min() > 1.5 and np.abs(tints - 1.0).max() > 0.03


def test_light_is_amplified_and_cut_off() -> None:
    assert (capture_noise.srgb(capture_noise.linear(np.arange(256, dtype=np.uint8))) == np.arange(256)).all()
    grey = np.full((8, 8, 3), 0.3, np.float32)
    colour = hand_held.exposed(grey, np.array([1.0, 2.0, 4.0]), None, np.zeros((8, 8), bool))
    assert np.allclose(capture_noise.linear(colour[4, 4]), [0.3, 0.6, 1.0], atol=0.005)


def test_borders_are_black_in_every_frame_and_nowhere_else(captured: Path, exact: Path) -> None:
    pictures = np.stack([frame.read_colour(None) for frame in open_scene(captured).frames])
    black = (pictures == 0).all((0, -1))
    assert (black == capture_noise.border_mask((160, 120), NOISE, random_border())).all()
    assert (np.stack([frame.read_colour(None) for frame in open_scene(exact).frames]).max((0, -1)) > 0).all()


def test_jpeg_keeps_borders_nearly_black(tmp_path: Path) -> None:
    source = write_tiny_scene(tmp_path / "source", frames=6, size=(320, 240), colour_format="jpg")
    hand_held.write_hand_held(source, tmp_path / "out", seed=0)
    black = capture_noise.border_mask((320, 240), NOISE, random_border())
    for frame in open_scene(tmp_path / "out").frames:
        assert frame.colour_path.suffix == ".jpg" and frame.read_colour(None)[black].max() <= 16


def random_border() -> np.random.Generator:
    stream: np.random.Generator = class_belief.stream(0, "border")
    return stream


@pytest.mark.parametrize("seed", range(5))
def test_borders_are_thin_and_curved(seed: int) -> None:
    black = capture_noise.border_mask((640, 480), NOISE, random(seed))
    inner = black[40:-40, 40:-40]
    assert not inner.any()
    for strip in (black[40:-40, :40], black[40:-40, -40:], black[:40, 40:-40].T, black[-40:, 40:-40].T):
        widths = strip.sum(-1)
        assert 6 <= widths.min() and widths.max() <= 16 and widths.max() > widths.min()


def test_a_tenth_of_the_frames_is_blurred() -> None:
    blurred = capture_noise.blurred_frames(70, NOISE, random())
    lengths = [np.linalg.norm(motion) * 640.0 for motion in blurred.values()]
    assert len(blurred) == 7 and 5.0 <= min(lengths) and max(lengths) <= 11.0


def test_blur_spreads_light_along_the_motion() -> None:
    light = np.zeros((41, 41, 3), np.float32)
    light[20, 20] = 1.0
    blurred = capture_noise.motion_blur(light, np.array([8.0, 0.0]))[..., 0]
    assert blurred.sum() == pytest.approx(1.0, abs=1e-5)
    assert blurred[20].sum() == pytest.approx(1.0, abs=1e-5)
    row = blurred[20]
    across = np.arange(41) - 20.0
    assert (row * across).sum() == pytest.approx(0.0, abs=1e-4)
    assert np.sqrt((row * across**2).sum()) == pytest.approx(8.0 / np.sqrt(12.0), rel=0.08)


def test_depth_noise_grows_with_the_square() -> None:
    for z in (0.8, 2.0, 4.0, 6.0):
        errors = depth_sensor.noisy(np.full((240, 320), z), NOISE, random()) - z
        expected = 0.0012 + 0.0019 * (z - 0.4) ** 2
        assert errors.std() == pytest.approx(expected, rel=0.1)
        # Neighbours err alike, pixels that are far apart do not.
        near = np.corrcoef(errors[:, 1:].ravel(), errors[:, :-1].ravel())[0, 1]
        far = np.corrcoef(errors[:, 20:].ravel(), errors[:, :-20].ravel())[0, 1]
        assert near > 0.7 and abs(far) < 0.1


def test_depth_steps_grow_with_the_square() -> None:
    depth = np.linspace(0.5, 8.0, 100_000).reshape(100, 1000)
    measured = depth_sensor.quantised(depth, NOISE)
    levels = np.unique(measured)
    middle, steps = (levels[1:] + levels[:-1]) / 2.0, np.diff(levels)
    assert np.allclose(steps / middle**2, 0.125 / 43.5, rtol=0.01)
    assert (np.abs(measured - depth) < 0.52 * 0.125 / 43.5 * measured**2 + 1e-9).all()


def test_no_depth_stays_none() -> None:
    depth = np.zeros((24, 32))
    for step in (depth_sensor.flying_pixels, depth_sensor.noisy):
        assert (step(depth, NOISE, random()) == 0.0).all()
    assert (depth_sensor.quantised(depth, NOISE) == 0.0).all() and (depth_sensor.half_size(depth, NOISE) == 0.0).all()


def test_half_the_size_shows_the_same_planes() -> None:
    wide = rays((121, 160))
    plane = 1.0 / (0.4 + 0.1 * wide[..., 0] + 0.2 * wide[..., 1])
    half = depth_sensor.half_size(plane, NOISE)
    assert half.shape == (61, 80)
    middle = wide[:120].reshape(60, 2, 80, 2, 3).mean((1, 3))
    assert np.allclose(half[:60], 1.0 / (0.4 + 0.1 * middle[..., 0] + 0.2 * middle[..., 1]), atol=1e-9)
    step = np.full((4, 8), 3.0)
    step[:, :3] = 1.0
    step[0, 6] = 0.0
    assert np.allclose(depth_sensor.half_size(step, NOISE), [[1.0, 1.0, 3.0, 3.0]] * 2)


def test_pixels_fly_at_edges_only() -> None:
    step = np.full((120, 160), 3.0)
    step[:, :80] = 1.0
    torn = depth_sensor.flying_pixels(step, NOISE, random())
    moved = torn != step
    assert not moved[:, :79].any() and not moved[:, 81:].any()
    assert 0.2 < moved[:, 79:81].mean() < 0.6
    assert ((torn[moved] > 1.0) & (torn[moved] < 3.0)).all()
    floor = floor_below(1.5)
    assert (depth_sensor.flying_pixels(floor, NOISE, random()) == floor).all()


def test_what_swallows_or_mirrors_light_has_no_depth() -> None:
    light = np.full((120, 160, 3), 0.25, np.float32)
    light[10:30, 10:30] = 0.002
    light[60:66, 100:106] = 0.9
    light[90:96, 100:106] = (0.9, 0.1, 0.1)
    dark, shiny = depth_sensor.darkness(light, NOISE), depth_sensor.highlights(light, NOISE)
    assert (dark[10:30, 10:30] == 1.0).all() and dark.sum() == 400.0
    assert (shiny[60:66, 100:106] == 1.0).all() and shiny.sum() == 36.0


def test_grazing_and_far_surfaces_have_no_depth() -> None:
    wall = np.full((120, 160), 2.0)
    wall[:, :50] = 1.0
    assert (depth_sensor.slant(wall, rays(), NOISE) == 0.0).all()  # an edge is not a slant
    floor = floor_below(1.5)
    down = rays()[..., 1] / np.linalg.norm(rays(), axis=-1)  # the cosine, as the floor's normal points up
    slant = depth_sensor.slant(floor, rays(), NOISE)
    known = np.arange(120)[:, None] > 61 + np.zeros((1, 160))
    assert np.allclose(slant[known], ((0.25 - down[known]) / 0.15).clip(0.0, 1.0), atol=1e-6)
    assert depth_sensor.distance(np.array([3.0, 6.0, 7.0, 8.0, 12.0]), NOISE).tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]


def test_polished_patches_belong_to_the_world() -> None:
    waves = depth_sensor.polish_waves(NOISE, random())
    points = random(1).uniform(-20.0, 20.0, (100, 400, 3))
    patches = depth_sensor.polish(points, waves, NOISE)
    assert 0.01 < patches.mean() < 0.03
    assert (depth_sensor.polish(points[::-1, ::-1], waves, NOISE)[::-1, ::-1] == patches).all()


@pytest.mark.parametrize("chance", [0.0, 0.1, 0.5, 0.97])
def test_holes_are_as_frequent_as_their_chance(chance: float) -> None:
    found = depth_sensor.holes(np.full((480, 640), chance), NOISE, random())
    assert found.mean() == pytest.approx(chance, abs=0.04)


def test_depth_with_a_lens_of_its_own_comes_out_on_the_colours(tmp_path: Path) -> None:
    source = write_tiny_scene(tmp_path / "source", frames=6)
    lens = np.loadtxt(source / "intrinsic/intrinsic_color.txt")
    lens[0, 0] *= 1.1
    np.savetxt(source / "intrinsic/intrinsic_depth.txt", lens)
    hand_held.write_hand_held(source, tmp_path / "out", seed=0)
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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], bad: str
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
    assert hand_held.main() == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ") and told.count("\n") == 1
    assert not (out.exists() and any(out.iterdir()))
    with pytest.raises(PlgsError):
        hand_held.write_hand_held(scene, out, seed=0)
