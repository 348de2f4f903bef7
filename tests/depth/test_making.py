"""Depth made by a network: its code path with random weights, its values with the sample's depth, bent as they do."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from engine.command_line.main import main
from engine.depth_making import DepthNetwork, load_depth_network, make_depth
from engine.job import LiftFolder, LiftRequest, read_manifest, write_manifest
from engine.job.report import estimated_text
from engine.scene import open_scene
from engine.scene.made import scale_of
from engine.scene_of_lift import estimates_of, remember_scene
from tests.depth.bent_room import ROOM, bent, fitted
from tests.raises_key import raises_key
from tests.scene.formats.room import look, views
from tests.scene.refusing import refuses
from tests.scene.test_depth import LENS, write_colmap

transformers = pytest.importorskip("transformers", reason="needs transformers (requirements/segment.txt)")


def save_tiny_depth_network(folder: Path) -> Path:
    """A Depth Anything with random weights, as transformers itself saves one."""
    import torch

    torch.manual_seed(2)
    backbone = transformers.Dinov2Config(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, image_size=56, patch_size=14,
        out_indices=[1, 2, 3, 4], reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, patch_size=14, neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8, head_hidden_size=4,
    )  # fmt: skip
    transformers.DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    processor = transformers.DPTImageProcessorPil(
        size={"height": 56, "width": 56}, keep_aspect_ratio=True, ensure_multiple_of=14
    )
    processor.save_pretrained(folder)
    told = folder / "preprocessor_config.json"  # the hub's names the older class
    told.write_text(told.read_text().replace("DPTImageProcessorPil", "DPTImageProcessor"))
    return folder


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_depth_network(tmp_path_factory.mktemp("depth"))


def test_distorted_depth_maps_are_fitted_to_within_four_centimetres() -> None:
    errors, covered = [], []
    for _, depth, truth in fitted([*open_scene(ROOM).frames[::2]]):
        both = (depth > 0) & (truth > 0)
        errors.append(np.abs(depth - truth)[both])
        covered.append(both.sum() / (truth > 0).sum())
    found = np.concatenate(errors)
    assert np.median(found) < 0.04 and (found < 0.1).mean() > 0.8 and np.mean(covered) > 0.75


def rooms_network(scale: float = 1.0) -> DepthNetwork:
    """Knows the room: bent disparity of each view, which it tells by the picture."""
    known = {look(view, LENS).colour.tobytes(): look(view, LENS.scaled(4)).depth for view in views()}
    return DepthNetwork("tests/room", lambda colour: bent(known[colour.tobytes()] * scale, 4))


def quiet(done: int, total: int) -> None:
    assert 0 <= done <= total


def test_estimated_depth_that_fits_no_sparse_points_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_colmap(tmp_path / "scene")
    flat = DepthNetwork("tests/flat", lambda colour: np.ones(colour.shape[:2], np.float32))
    with raises_key("depth-unrelated"):
        make_depth(open_scene(folder), folder, flat, quiet)
    assert not (folder / "made_depth").exists()  # where another network may follow
    monkeypatch.setattr("engine.depth_making.LEAST_POINTS", 10**6)
    with raises_key("few-points"):
        make_depth(open_scene(folder), folder, flat, quiet)
    assert not open_scene(folder).has_depth


def test_estimated_depth_is_found_and_reported_when_the_scene_opens(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "scene")
    assert not open_scene(folder).has_depth
    warnings = make_depth(open_scene(folder), folder, rooms_network(), quiet)
    assert len(warnings) == 1 and "12 points" in warnings[0]
    scene = open_scene(folder)
    assert scene.has_depth and len(scene.frames) == 5  # one sees few points
    assert any(each.startswith("estimated: depth is made of the photos by tests/room") for each in scene.warnings)
    assert any(each.startswith("estimated: lengths") for each in scene.warnings)
    off = [
        np.abs(one.depth((64, 48)) / look(view, LENS).depth - 1)
        for one, view in zip(scene.frames, views()[1:], strict=True)
    ]
    assert np.median(np.concatenate([each.ravel() for each in off])) < 0.05
    assert not (folder / "made_depth" / "raw").exists()
    assert make_depth(open_scene(folder), folder, rooms_network(), quiet) == []
    with raises_key("other-depth"):
        make_depth(open_scene(folder), folder, DepthNetwork("tests/other", lambda colour: colour[..., 0]), quiet)
    images = folder / "sparse" / "0" / "images.txt"
    lines = images.read_text().splitlines()
    words = lines[2].split()
    lines[2] = " ".join([*words[:5], str(float(words[5]) + 3), *words[6:]])
    images.write_text("\n".join(lines) + "\n")
    refuses("other-poses made_depth", folder)


def test_stopped_depth_estimation_continues_and_leaves_other_files_alone(tmp_path: Path) -> None:
    folder, network, seen = write_colmap(tmp_path / "scene"), rooms_network(), list[int]()

    def counted(colour: np.ndarray) -> np.ndarray:
        seen.append(1)
        return network.look(colour)

    def stop(done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_depth(open_scene(folder), folder, DepthNetwork(network.name, counted), stop)
    assert len(seen) == 3 and not open_scene(folder).has_depth
    make_depth(open_scene(folder), folder, DepthNetwork(network.name, counted), quiet)
    assert len(seen) == 5 and open_scene(folder).has_depth
    other = write_colmap(tmp_path / "other")
    (other / "made_depth").mkdir()
    (other / "made_depth" / "mine.npy").write_bytes(b"mine")
    with raises_key("folder-used"):
        make_depth(open_scene(other), other, network, quiet)


def test_engine_depth_runs_a_depth_network_with_random_weights(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = load_depth_network(str(model), download=False)
    for shape in ((48, 64, 3), (900, 1200, 3)):
        values = network.look(np.random.default_rng(0).integers(0, 255, shape, np.uint8))
        assert values.shape == (48, 64) if shape[0] == 48 else (480, 640)
        assert np.isfinite(values).all() and values.std() > 0
    folder = write_colmap(tmp_path / "scene")
    assert main(["depth", str(folder), "--model", str(model)]) == 0
    told = capsys.readouterr()
    assert told.out.startswith("Depth of 6 frames") and "licence" in told.err and "Making depth" in told.err
    record = json.loads((folder / "made_depth" / "made_by.json").read_text())
    assert record["model"] == str(model.resolve()) and "licence" in record
    assert main(["depth", str(folder), "--model", str(model)]) == 0
    assert main(["depth", str(ROOM), "--model", str(model)]) == 2
    assert "already has measured or given depth" in capsys.readouterr().err
    with raises_key("not-downloaded"):
        load_depth_network("nobody/no-such-network", download=False)


def test_a_length_measured_in_metres_sets_the_scale_of_the_scene(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "scene")
    make_depth(open_scene(folder), folder, rooms_network(), quiet)
    before = open_scene(folder)
    assert main(["scale", str(folder), "--measured", "2.0", "3.0"]) == 0
    assert main(["scale", str(folder), "--measured", "1.0", "2.0"]) == 0
    after = open_scene(folder)
    assert scale_of(folder) == 3.0 and not any("unknown" in each for each in after.warnings)
    ratio = lambda scene: np.linalg.norm(scene.frames[0].camera.centre - scene.frames[3].camera.centre)  # noqa: E731
    assert ratio(after) == pytest.approx(3 * ratio(before))
    np.testing.assert_allclose(after.frames[1].depth(), 3 * before.frames[1].depth(), rtol=1e-5)
    assert after.points is not None and before.points is not None
    np.testing.assert_allclose(after.points.xyz, 3 * before.points.xyz, atol=1e-9)
    assert main(["scale", str(folder), "--factor", "-1"]) == 2
    assert main(["scale", str(ROOM), "--factor", "2"]) == 2, "it has metres"
    assert main(["scale", str(folder), "--factor", "1"]) == 0 and scale_of(folder) == 1.0


NOTES = ("scale.json", "sparse/0/made_by.json", "made_depth/made_by.json", "panoptic/made_by.json")
WRONG_SCALES = (
    "", "{", "[2]", "{}", *(f'{{"scale": {each}}}' for each in (
        "true", "null", "0", "-2", '"2"', "[2]", "NaN", "1e999", "1e5", "9" * 400)),
    '{"scale": 2, "unit": "m"}', '{"format": 2, "scale": 2}',
)  # fmt: skip


@pytest.mark.parametrize("content", WRONG_SCALES)
def test_a_wrong_scale_json_is_refused_and_following_the_advice_mends_it(content: str, tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "scene")
    (folder / "scale.json").write_text(content)
    assert refuses("* scale.json", folder).fix
    assert main(["scale", str(folder), "--factor", "2"]) == 2
    (folder / "scale.json").unlink()  # as each says
    assert main(["scale", str(folder), "--factor", "2"]) == 0


@pytest.mark.parametrize("note", NOTES)
@pytest.mark.parametrize("kind", ["link", "fifo", "folder"])
def test_a_depth_or_scale_note_that_cannot_be_read_is_an_error(note: str, kind: str, tmp_path: Path) -> None:
    path = write_colmap(tmp_path / "scene") / note
    path.parent.mkdir(exist_ok=True)
    {"link": lambda: path.symlink_to("nowhere"), "fifo": lambda: os.mkfifo(path), "folder": path.mkdir}[kind]()
    refuses(f"unreadable {note}", tmp_path / "scene")


@pytest.mark.parametrize(
    "changes",
    [{"photos": [1, 2]}, {"photos": {"1": [1]}}, {"layout": {"1": ["a", "b"]}}, {"layout": {"1": [1.0]}}, {"model": 3},
     {"frames": "all"}, {"unit": "m"}],
)  # fmt: skip
def test_a_damaged_made_by_json_of_estimated_depth_is_refused(changes: dict[str, object], tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "scene")
    make_depth(open_scene(folder), folder, rooms_network(), quiet)
    note = folder / "made_depth" / "made_by.json"
    note.write_text(json.dumps(json.loads(note.read_text()) | changes))
    refuses("wrong-type|unknown-field made_by.json", folder)


SETTINGS: dict[str, tuple[str, str, object]] = {
    "another type": ("config.json", "patch_size", "x"),
    "endless layers": ("config.json", "backbone_config", {"model_type": "dinov2", "num_hidden_layers": 10**8}),
    "endless features": ("config.json", "fusion_hidden_size", 10**9),
    "a vast picture": ("preprocessor_config.json", "size", {"height": 10**6, "width": 10**6}),
    "no picture": ("preprocessor_config.json", "size", {"height": 0, "width": 0}),
    "a picture below none": ("preprocessor_config.json", "size", {"height": -56, "width": -56}),
    "two colours": ("preprocessor_config.json", "image_mean", [0.5, 0.5]),
    "no number": ("preprocessor_config.json", "rescale_factor", 1e300),
}
"""Settings of a network that it cannot be loaded or run with."""


@pytest.mark.parametrize("name", [*SETTINGS, "a list", "half of the weights"])
def test_a_depth_network_that_cannot_run_gives_a_one_line_error(
    name: str, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, network = write_colmap(tmp_path / "scene"), tmp_path / "network"
    shutil.copytree(model, network)
    if name == "half of the weights":
        (network / "model.safetensors").write_bytes((network / "model.safetensors").read_bytes()[:5000])
    elif name == "a list":
        (network / "preprocessor_config.json").write_text("[]")
    else:
        file, key, value = SETTINGS[name]
        content = json.loads((network / file).read_text()) | {key: value}
        (network / file).write_text(json.dumps(content))
    assert main(["depth", str(folder), "--model", str(network)]) == 2
    told = capsys.readouterr().err
    assert "Traceback" not in told and "error: " in told.splitlines()[-1]
    assert main(["depth", str(folder), "--model", str(model)]) == 0, "another one can be named"


def test_a_lifts_manifest_and_report_say_that_depth_was_estimated(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "scene")
    make_depth(open_scene(folder), folder, rooms_network(), quiet)
    record = folder / "made_depth" / "made_by.json"
    record.write_text(json.dumps({**json.loads(record.read_text()), "licence": "mine", "commercial_use": False}))
    lift = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=folder))
    remember_scene(lift, open_scene(folder))
    lift.result_path.mkdir(exist_ok=True)
    write_manifest(
        lift.result_path, versions={}, seed=0, settings={}, timings={}, estimated=estimates_of(lift)
    )  # fmt: skip
    kept = read_manifest(lift.result_path).estimated
    assert len(kept) == 3 and "tests/room" in kept[0] and "mine" in kept[1] and "scale, which is unknown" in kept[2]
    assert estimated_text(lift).startswith("Estimated: depth is made of the photos by tests/room")
