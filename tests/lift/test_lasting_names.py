"""A scene that is lifted again keeps the names and ids of its objects, in every file of the result."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from engine.corrections import correct, making, read_corrected, read_edits, undo
from engine.instances.records import SceneObject
from engine.job import EventWriter, LiftFolder, LiftRequest, read_manifest, write_manifest
from engine.lift import run as lift_run
from engine.lift import scene_files
from engine.lift.kept_corrections import report_edits, take_over_edits
from engine.lift.lasting_names import EarlierLift, lasting_names, read_earlier
from engine.passes.exr import read_exr
from engine.result_files import SemanticPoints, read_arrays
from engine.scene import Category, ClassTable, open_scene
from tests.corrections.two_rooms import CRUMB, DESK, write_result
from tests.raises_key import raises_key
from tests.tiny_scene import CABINET, CHAIR, write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as

FRAMES = 6
CLASSES = ClassTable((Category(3, "cabinet", True, (1, 1, 1)), Category(5, "chair", True, (2, 2, 2))))


def instance(number: int, class_id: int) -> SceneObject:
    return SceneObject(number, (), class_id)


def corner(number: int) -> np.ndarray:
    """Points of an object at a place of its own."""
    return np.random.default_rng(0).uniform(0, 0.4, (4000, 3)) + [2.0 * number, 0.0, 0.0]


def test_new_objects_get_ids_that_were_never_used_before() -> None:
    xyz, owner = np.concatenate([corner(0), corner(1), corner(2)]), np.repeat([1, 2, 4], 4000).astype(np.int32)
    names = {1: "chair 1", 2: "chair 2", 4: "cabinet 1"}
    kinds = {1: "chair", 2: "chair", 4: "cabinet"}
    earlier = EarlierLift(Path("/old"), names, kinds, xyz, owner, 7, {"chair": 3, "cabinet": 1})
    now = np.concatenate([corner(5), corner(2), corner(1)])
    found = [instance(1, 5), instance(2, 5), instance(3, 5)]
    lasting = lasting_names(earlier, found, now, np.repeat([1, 2, 3], 4000).astype(np.int32), CLASSES)
    assert lasting.id_of == {1: 8, 2: 4, 3: 2}
    assert lasting.names == {8: "chair 4", 4: "chair 5", 2: "chair 2"}
    changes = lasting.changes
    assert changes["kept"] == [{"id": 2, "name": "chair 2"}]
    assert changes["renamed"] == [{"id": 4, "name": "chair 5", "was": "cabinet 1"}]
    assert changes["new"] == [{"id": 8, "name": "chair 4"}]
    assert changes["gone"] == [{"id": 1, "name": "chair 1"}]
    assert changes["largest_id"] == 8 and changes["last_numbers"] == {"chair": 5, "cabinet": 1}


def is_beside_cabinet(xyz: np.ndarray) -> np.ndarray:
    """Places on the cabinet or near it, above the floor: as if no depth showed it, so that only its foot is written."""
    near = (xyz[:, :2] > CABINET[0, :2] - 0.5) & (xyz[:, :2] < CABINET[1, :2] + 0.5)
    return np.asarray(near.all(axis=1) & (xyz[:, 2] > 0.02))


@pytest.fixture(scope="module")
def lifts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LiftFolder, LiftFolder]]:
    """A room lifted, with ids as after many lifts; then after the first's names, with another preset, of a recording
    that goes on for as many frames again."""
    root = tmp_path_factory.mktemp("names")
    finer = replace(TINY, steps=15, voxel_size=0.15, gaussians_per_anchor=4)
    with presets_as(preview=TINY, standard=finer), pytest.MonkeyPatch.context() as patched:
        patched.setattr(scene_files, "FILLED", 0.25)
        patched.setattr(lift_run, "shown_by_depth", lambda cloud, *_: ~is_beside_cabinet(cloud.xyz))
        few = write_tiny_scene(root / "few", frames=FRAMES, noise=0.1)
        first = lift_into(root / "first", LiftRequest(scene=few))
        renumber(first)
        many = write_tiny_scene(root / "many", frames=2 * FRAMES, noise=0.1)
        request = LiftRequest(scene=many, preset="standard", seed=3, names_from=first.path)
        yield first, lift_into(root / "again", request)


def records_of(folder: LiftFolder) -> dict[int, str]:
    content = json.loads((folder.result_path / "instances.json").read_text())
    return {one["id"]: one["name"] for one in content["instances"]}


def names_of(folder: LiftFolder) -> dict[str, list[dict[str, Any]]]:
    content: dict[str, list[dict[str, Any]]] = json.loads((folder.result_path / "names.json").read_text())
    return content


def renumber(folder: LiftFolder) -> None:
    """As if the objects were called otherwise: ids 11, 12, ... and names with 70, 69, ..."""
    path = folder.result_path / "instances.json"
    content = json.loads(path.read_text())
    for one in content["instances"]:
        one["name"] = f"{one['class_name']} {70 - one['id']}"
        one["id"] += 10
    path.write_text(json.dumps(content))
    points = dict(np.load(folder.result_path / "semantic_points.npz"))
    points["instance_id"] = np.where(points["instance_id"] > 0, points["instance_id"] + 10, 0).astype(np.int32)
    np.savez(folder.result_path / "semantic_points.npz", **points)
    settings = json.loads(folder.manifest_path.read_text())["settings"]
    folder.manifest_path.unlink()
    write_manifest(folder.result_path, versions={}, seed=0, settings=settings, timings={})


def test_a_new_lift_keeps_ids_in_all_files(lifts: tuple[LiftFolder, LiftFolder]) -> None:
    first, again = lifts
    before, after = records_of(first), records_of(again)
    assert len(open_scene(again.request.scene).frames) == 2 * len(open_scene(first.request.scene).frames)
    assert [read_manifest(one.result_path).settings["voxel_size"] for one in lifts] == [0.2, 0.15]
    kept = names_of(again)["kept"]
    assert len(kept) >= 2 and {(one["id"], one["name"]) for one in kept} <= set(before.items()) & set(after.items())
    for file in ("semantic_points.npz", "anchors.npz"):
        with np.load(again.result_path / file) as arrays:
            assert set(np.unique(arrays["instance_id"]).tolist()) - {0} <= set(after)
    for exr in again.passes_path.iterdir():
        shown = set(np.unique(read_exr(exr).instance).tolist()) - {0}
        assert shown and shown <= set(after)


def test_an_object_with_few_measured_points_keeps_its_name(lifts: tuple[LiftFolder, LiftFolder]) -> None:
    """Its points in the files are a fifth of those that it has before they are written."""
    for lift in lifts:
        points = read_arrays(lift.result_path / "semantic_points.npz", SemanticPoints)
        assert points.xyz[(points.instance_id > 0) & (points.xyz[:, 0] > CHAIR[1, 0] + 0.1), 2].max() < 0.4
    assert "cabinet" in {one["name"].split()[0] for one in names_of(lifts[1])["kept"]}


def test_names_from_refuses_an_unfinished_lift(tmp_path: Path, lifts: tuple[LiftFolder, LiftFolder]) -> None:
    with raises_key("no-lift-folder"):
        read_earlier(tmp_path / "nothing")
    other = LiftFolder.create(tmp_path / "begun", LiftRequest(scene=lifts[0].request.scene))
    with raises_key("not-finished"):
        read_earlier(other.path)


def with_history(folder: LiftFolder, history: object) -> None:
    (folder.result_path / "names.json").write_text(json.dumps(history))


def with_instances(folder: LiftFolder, change: Callable[[list[dict[str, Any]]], object]) -> None:
    path = folder.result_path / "instances.json"
    content = json.loads(path.read_text())
    change(content["instances"])
    path.write_text(json.dumps(content))


IMPOSSIBLE: dict[str, Callable[[LiftFolder], None]] = {
    **{
        f"largest id {given!r}": partial(with_history, history={"largest_id": given})
        for given in (65535, 2**31, -5, "x")
    },
    **{
        f"last number {given!r}": partial(with_history, history={"last_numbers": given})
        for given in ({"chair": -1}, {"chair": 10**30}, [3])
    },
    "an object that is not listed": partial(with_instances, change=list.pop),
    "no object listed": partial(with_instances, change=list.clear),
    "an id too large": partial(with_instances, change=lambda listed: listed[0].update(id=65536)),
    "an id with no room above": partial(
        with_instances, change=lambda listed: listed.append({**listed[0], "id": 65535})
    ),
}


@pytest.mark.parametrize("spoilt", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_names_from_a_bad_folder_is_refused_before_work(spoilt: Callable[[LiftFolder], None], tmp_path: Path) -> None:
    """In the lift's first stage, in one line that says which option it is about."""
    earlier = LiftFolder.create(tmp_path / "old", LiftRequest(scene=tmp_path))
    write_result(earlier.path)
    spoilt(earlier)
    write_manifest(earlier.result_path, versions={}, seed=0, settings={}, timings={})
    scene = write_tiny_scene(tmp_path / "scene", frames=2)
    with presets_as(preview=TINY), raises_key("names-unreadable") as raised:
        lift_into(tmp_path / "new", LiftRequest(scene=scene, names_from=earlier.path))
    stages = [json.loads(line) for line in (tmp_path / "new/events.jsonl").read_text().splitlines()]
    assert [each["name"] for each in stages if each["event"] == "stage"] == ["check"] and raised.value.option


def test_corrections_of_the_old_lift_are_kept_or_reported_as_lost(tmp_path: Path) -> None:
    folders = [LiftFolder.create(tmp_path / name, LiftRequest(scene=tmp_path)) for name in ("old", "new")]
    for folder, (shift, without) in zip(folders, [(0.0, 0), (0.011, CRUMB)], strict=True):
        write_result(folder.path, shift, without)
        write_manifest(folder.result_path, versions={}, seed=0, settings={}, timings={})
    old, new = folders
    correct(old.path, lambda state, _: making.rename(state, DESK, "desk"))
    correct(old.path, lambda state, free: making.split(state, 1, making.parts_of(state.points_of(1)), free))
    correct(old.path, lambda state, _: making.delete(state, CRUMB))
    correct(old.path, lambda state, _: making.rename(state, 1, "undone"))
    undo(old.path)
    earlier = read_earlier(old.path)
    assert earlier.largest_id == 4 and earlier.last_numbers["chair"] == 2  # no new object gets the id or name of a part
    events = EventWriter(new.events_path)
    for _ in range(2):  # a lift that is resumed does it again
        take_over_edits(new, earlier)
    report_edits(new, earlier, {}, events)
    events.close()
    assert [edit.kind for edit in read_edits(new.path)] == ["rename", "split", "delete"]
    assert {one.id: one.name for one in read_corrected(new.path).instances} == {1: "chair 1", 2: "desk", 4: "chair 2"}
    warned = [json.loads(line)["message"] for line in new.events_path.read_text().splitlines()]
    assert "there is no object 3" in warned[0] and "2 corrections" in warned[1]
