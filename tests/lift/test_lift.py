"""Whole lifts of the tiny room: what they write, that they write it again, and what ground truth may touch."""

import json
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import OpenEXR
import pytest

from engine.errors import Cancelled
from engine.job import LiftFolder, LiftRequest, progress, verify
from engine.lift import frame_sets, scene_files
from engine.lift import run as lift_run
from engine.lift.run import STAGES
from engine.lift.scene_files import FILLED, is_near_measured, read_model, shown_by_depth
from engine.model.baking import FLOATS
from engine.posed.ply import read_gaussians
from engine.result_files import Anchors, SemanticPoints, read_arrays
from engine.scene import load_view, open_scene
from engine.scene.mask_formats import coco
from engine.semantics.point_cloud import SemanticPointCloud
from tests.tiny_scene import CABINET_ID, CHAIR_ID, write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as, run

FRAMES = 10
HELD_OUT = ["0004"]


@dataclass(frozen=True)
class Lifts:
    """A scene, and one lift of it that most tests look at."""

    root: Path
    scene: Path
    done: LiftFolder

    def lift(self, name: str, scene: Path | None = None, **request: object) -> LiftFolder:
        return lift_into(self.root / name, LiftRequest(scene=scene or self.scene, **request))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def lifts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lifts]:
    root = tmp_path_factory.mktemp("lifts")
    scene = write_tiny_scene(root / "scene", frames=FRAMES, noise=0.1)
    with presets_as(preview=TINY):
        yield Lifts(root, scene, lift_into(root / "done", LiftRequest(scene=scene)))


def files_of(folder: LiftFolder) -> dict[str, str]:
    """SHA-256 by path of a result that was verified against its manifest."""
    return {file.path.as_posix(): file.sha256 for file in verify(folder.result_path).files}


def test_a_lift_writes_the_documented_files(lifts: Lifts) -> None:
    expected = {"semantic_points.npz", "instances.json", "anchors.npz", "gaussians.ply", "model.safetensors"}
    expected |= {"metrics.json", "previews/contact_sheet.png"}
    for name in HELD_OUT:
        previews = {f"previews/{name}_{kind}.png" for kind in ("colour", "semantic", "instance")}
        expected |= {f"passes/{name}.exr"} | previews
    assert set(files_of(lifts.done)) == expected
    on_disk = {path.relative_to(lifts.done.result_path) for path in lifts.done.result_path.rglob("*") if path.is_file()}
    assert {path.as_posix() for path in on_disk} == expected | {"manifest.json"}


def test_the_manifest_records_seed_settings_times_and_versions(lifts: Lifts) -> None:
    manifest = verify(lifts.done.result_path)
    assert manifest.seed == 0 and manifest.settings["steps"] == TINY.steps
    assert set(manifest.timings) == set(STAGES)
    assert {"python", "numpy", "torch", "numba"} <= set(manifest.versions)


def test_a_lift_writes_its_points_and_anchors(lifts: Lifts) -> None:
    points = read_arrays(lifts.done.result_path / "semantic_points.npz", SemanticPoints)
    assert set(np.unique(points.instance_id)) == {0, 1, 2}
    assert ((points.confidence >= 0) & (points.confidence <= 1)).all()
    anchors = read_arrays(lifts.done.result_path / "anchors.npz", Anchors)
    assert set(np.unique(anchors.level)) <= {0, 1, 2, 3}


def test_splats_and_points_stay_near_measured_surface(lifts: Lifts, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if no depth showed one half of the room. Its anchors are not listed, but the model keeps them."""
    monkeypatch.setattr(progress, "REPORT_EVERY_S", 0.0)
    every = read_arrays(lifts.done.result_path / "semantic_points.npz", SemanticPoints).xyz[:, 0]
    middle = float(np.median(every))
    monkeypatch.setattr("engine.lift.run.shown_by_depth", lambda cloud, *_: cloud.xyz[:, 0] < middle)
    run(half := LiftFolder.create(lifts.root / "half", LiftRequest(scene=lifts.scene)))
    whole, left = (read_gaussians(each.result_path / "gaussians.ply") for each in (lifts.done, half))
    beyond = left[left["x"] > middle + scene_files.FILLED + FLOATS]
    assert len(beyond) < 0.7 * np.count_nonzero(whole["x"] > middle + scene_files.FILLED + FLOATS)
    assert np.count_nonzero(left["x"] < middle) > 0.9 * np.count_nonzero(whole["x"] < middle)
    points = read_arrays(half.result_path / "semantic_points.npz", SemanticPoints)
    assert points.xyz[:, 0].max() <= middle + scene_files.FILLED and len(points.xyz) < 0.9 * len(every)
    reach = max(scene_files.FILLED, 2 * TINY.voxel_size)
    anchors, of_model = read_arrays(half.result_path / "anchors.npz", Anchors).xyz, read_model(half).anchors.position
    assert len(anchors) < 0.9 * len(of_model) and anchors[:, 0].max() <= points.xyz[:, 0].max() + reach
    told = [json.loads(line) for line in half.events_path.read_text().splitlines()]
    steps = [one["step"] for one in told if one["event"] == "progress" and one["stage"] == "result"]
    assert steps == sorted(steps) and len({step for step in steps if step > 100 * lift_run.SIFTED}) > 8
    listed = json.loads((half.result_path / "instances.json").read_text())["instances"]
    assert [one["points"] for one in listed] == [np.count_nonzero(points.instance_id == one["id"]) for one in listed]


def test_each_mask_is_decoded_at_most_twice_in_a_lift(lifts: Lifts, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded, before = Counter[str](), Counter[str]()
    read, train = coco._read_ids, lift_run.train
    monkeypatch.setattr(coco, "_read_ids", lambda png: decoded.update([png.stem]) or read(png))
    monkeypatch.setattr(lift_run, "train", lambda *all: before.update(decoded) or train(*all))
    monkeypatch.setattr(frame_sets, "main_memory", lambda: None)  # else it looks at some masks to predict the memory
    scene = shutil.copytree(lifts.scene, lifts.root / "without truth", ignore=shutil.ignore_patterns("gt"))
    run(LiftFolder.create(lifts.root / "decoded", LiftRequest(scene=scene, options={"size": (32, 24)})))
    names = {frame.name for frame in open_scene(scene).train_frames}
    assert {before[name] for name in names} == {1} and {decoded[name] for name in names} == {2}


def test_a_lift_writes_its_instances(lifts: Lifts) -> None:
    content = json.loads((lifts.done.result_path / "instances.json").read_text())
    assert content["format"] == 1 and content["up"] == "z"
    assert [one["id"] for one in content["classes"]] == [1, 2, 3, 5, 13]
    found = {one["name"]: one for one in content["instances"]}
    assert set(found) == {"chair 1", "cabinet 1"}
    assert {one["class_id"] for one in found.values()} == {CHAIR_ID, CABINET_ID}
    for one in found.values():
        assert one["id"] >= 1 and one["views"] >= 5 and 0 <= one["score"] <= 1 and one["points"] > 0
        assert len(one["centre"]) == len(one["size"]) == len(one["colour"]) == 3 and len(one["rotation"]) == 4
        assert not {segment["frame"] for segment in one["segments"]} & set(HELD_OUT)
        assert len(one["segments"]) >= one["views"]
        for segment in one["segments"]:
            assert segment["cost"] is None and 0 < segment["agreement"] <= 1, "matched by agreement, not by boxes"
            assert segment["pixels"] > 0 and 0 < segment["share"] < 1
            left, top, right, bottom = segment["rectangle"]
            assert 0 <= left < right <= 1 and 0 <= top < bottom <= 1


def test_passes_have_the_frames_size_and_unblended_labels(lifts: Lifts) -> None:
    for name in HELD_OUT:
        with OpenEXR.File(str(lifts.done.passes_path / f"{name}.exr"), separate_channels=True) as exr:
            channels = {key: channel.pixels for key, channel in exr.channels().items()}
        plgs = {key for key in channels if key.startswith("PLGS.")}
        single = {f"PLGS.{kind}.V" for kind in ("Depth", "Semantic", "Instance", "Confidence", "Entropy")}
        assert plgs == {f"PLGS.Combined.{letter}" for letter in "RGBA"} | single
        layers = {key.split(".")[0].rstrip("0123456789") for key in channels}
        assert layers == {*"RGBA", "PLGS", "CryptoInstance", "CryptoClass"}
        assert {pixels.shape for pixels in channels.values()} == {(48, 64)}
        assert set(np.unique(channels["PLGS.Semantic.V"])) <= {1.0, 2.0, 3.0, 5.0}
        assert set(np.unique(channels["PLGS.Instance.V"])) <= {0.0, 1.0, 2.0}
        picture = cv2.imread(str(lifts.done.previews_path / f"{name}_colour.png"))
        assert picture is not None and picture.shape == (48, 64, 3)


def test_metrics_compare_the_lift_with_its_masks(lifts: Lifts) -> None:
    metrics = json.loads((lifts.done.result_path / "metrics.json").read_text())
    assert metrics["format"] == 1 and metrics["test_frames"] == HELD_OUT
    rows = {(table["name"], table["mode"]): table for table in metrics["tables"]}
    assert len(rows) == 4 and {mode for _, mode in rows} == {"strict", "pl_compat"}
    assert {name.partition(" (")[0] for name, _ in rows} == {"input masks", "lifted"}
    for table in rows.values():
        assert all(0 <= table[figure] <= 1 for figure in ("miou", "pq", "sq", "rq"))
    lifted = rows["lifted", "strict"]
    assert lifted["psnr_fitted"] > lifted["psnr"] > 10
    assert 0 < lifted["depth_error_m"] < 1


def test_the_same_seed_gives_the_same_lift(lifts: Lifts) -> None:
    assert files_of(lifts.lift("again")) == files_of(lifts.done)
    other = files_of(lifts.lift("other", seed=1))
    assert other["model.safetensors"] != files_of(lifts.done)["model.safetensors"]


def test_ground_truth_affects_only_the_metrics(lifts: Lifts) -> None:
    blind = shutil.copytree(lifts.scene, lifts.root / "blind")
    shutil.rmtree(blind / "gt")
    with_truth, without = files_of(lifts.done), files_of(lifts.lift("without", blind))
    assert with_truth.keys() == without.keys()
    assert {name for name in without if without[name] != with_truth[name]} == {"metrics.json"}
    metrics = json.loads((lifts.root / "without" / "result" / "metrics.json").read_text())
    assert all(table.get("miou") is None for table in metrics["tables"])


def test_a_cancelled_lift_is_resumed(lifts: Lifts) -> None:
    folder = LiftFolder.create(lifts.root / "cancelled", LiftRequest(scene=lifts.scene))
    folder.cancel_path.touch()
    with pytest.raises(Cancelled):
        run(folder)
    folder.cancel_path.unlink()
    run(folder, resume=True)
    assert files_of(folder) == files_of(lifts.done)


def test_a_resumed_lift_trains_on_the_frames_it_began_with(lifts: Lifts, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it was begun six frames fitted; where it is resumed all would."""
    folder = LiftFolder.create(lifts.root / "small", LiftRequest(scene=lifts.scene, fit=True))
    with monkeypatch.context() as small:
        small.setattr(frame_sets, "frames_that_fit", lambda *_: 6)
        small.setattr(lift_run, "vote_labels", Mock(side_effect=Cancelled("asked to")))
        with pytest.raises(Cancelled):
            run(folder)
    run(folder, resume=True)
    assert files_of(folder) == files_of(lifts.lift("six", options={"frames": 6})) != files_of(lifts.done)


def test_a_lift_leaves_out_unreadable_frames(lifts: Lifts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = write_tiny_scene(tmp_path / "scene", frames=14, noise=0.1)
    for path in (scene / "color" / "0002.png", scene / "panoptic" / "0006.png", scene / "depth" / "0004.png"):
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 255
        path.write_bytes(bytes(data))
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene, bake="all"))
    with monkeypatch.context() as stopped:
        stopped.setattr(lift_run, "vote_labels", Mock(side_effect=Cancelled("asked to")))
        with pytest.raises(Cancelled):
            run(folder)
    run(folder, resume=True)
    metrics = json.loads((folder.result_path / "metrics.json").read_text())
    assert metrics["left_out"] == [{"lacks": "readable files", "count": 3, "names": ["0002", "0004", "0006"]}]
    assert metrics["test_frames"] == ["0012"]


def cloud_of(xyz: np.ndarray, spacing: float = 0.025) -> SemanticPointCloud:
    count = len(xyz)
    rgb, ids, one = np.zeros((count, 3), np.uint8), np.zeros(count, np.int32), np.ones(count, np.float32)
    return SemanticPointCloud(xyz.astype(np.float32), rgb, ids, one, one[:, None], (1,), spacing)


def test_points_in_holes_of_the_depth_do_not_count_as_measured(tmp_path: Path) -> None:
    """Points of two views, of which the second has a hole, and points 40 cm behind those of the first."""
    scene = open_scene(write_tiny_scene(tmp_path, frames=2, size=(80, 60)))
    first, second = (load_view(frame) for frame in scene.frames)
    holed = replace(second, depth=np.where(np.indices(second.depth.shape)[1] < 40, second.depth, np.float32(0)))
    on_it = [view.camera.unproject(view.depth)[::7, ::7].reshape(-1, 3) for view in (first, second)]
    beyond = first.camera.unproject(first.depth + 0.4)[::7, ::7].reshape(-1, 3)
    told: list[tuple[int, int]] = []
    cloud = cloud_of(np.concatenate([on_it[0], beyond]))
    is_shown = shown_by_depth(cloud, [first], lambda *done: told.append(done))
    assert is_shown[: len(on_it[0])].all() and not is_shown[len(on_it[0]) :].any() and told[-1] == (1, 1)
    assert shown_by_depth(cloud_of(on_it[1]), [second], lambda *_: None).all()
    half = shown_by_depth(cloud_of(on_it[1]), [holed], lambda *_: None)
    assert 0.4 < half.mean() < 0.6
    assert shown_by_depth(cloud_of(beyond, spacing=0.5), [first], lambda *_: None).all()  # means of so large cells
    assert not shown_by_depth(cloud, [], lambda *_: None).any()


def test_points_far_from_measured_surface_are_not_shown() -> None:
    """A row of points of which the first is measured; an object all of whose points lie far is kept."""
    xyz = np.stack([np.arange(0, 1, 0.1) + 0.01, np.zeros(10), np.zeros(10)], axis=1)
    owner = np.array([0, 0, 1, 1, 1, 1, 0, 0, 2, 2], np.int32)
    seen = is_near_measured(cloud_of(xyz), owner, np.arange(10) == 0)
    assert [*np.flatnonzero(seen)] == [0, 1, 2, 8, 9] and 0.2 < FILLED < 0.31
    assert is_near_measured(cloud_of(xyz), owner, np.zeros(10, np.bool_)).sum() == 6  # the objects
    assert is_near_measured(cloud_of(xyz, spacing=0.5), owner, np.arange(10) == 0).all()  # lie far apart
