"""What training starts from: instances, cloud, anchors and targets of the tiny room."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from engine.instances.records import SceneObject
from engine.lift import preparation
from engine.lift.objects import labels_of
from engine.lift.preparation import PreparedLift, label_channels
from engine.model.structured import NO_OBJECT, SPARE
from tests.tiny_scene import CABINET, CABINET_ID, CHAIR, CHAIR_ID, WALL_ID
from tests.train.tiny_lift import TINY, prepared_for, views_of, warnings_in

BOXES = {CHAIR_ID: CHAIR, CABINET_ID: CABINET}


@pytest.fixture(scope="module", params=["boxes", "agreement"])
def prepared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> PreparedLift:
    way: Literal["boxes", "agreement"] = request.param
    folder = tmp_path_factory.mktemp(way)
    views, classes = views_of(folder / "scene")
    return prepared_for(views, classes, replace(TINY, objects=way, voxel_size=0.1), folder)


def test_preparation_finds_the_objects_of_the_room(prepared: PreparedLift) -> None:
    assert sorted(instance.class_id for instance in prepared.instances) == [CABINET_ID, CHAIR_ID]
    assert sorted(instance.id for instance in prepared.instances) == [1, 2]
    for instance in prepared.instances:
        low, high = BOXES[instance.class_id]
        np.testing.assert_allclose(instance.box.centre, (low + high) / 2, atol=0.1)
        assert instance.box.volume == pytest.approx(np.prod(high - low), rel=0.35)
        assert instance.views == 7


def test_points_belong_to_the_object_on_whose_surface_they_lie(prepared: PreparedLift) -> None:
    cloud, owner = prepared.cloud, prepared.instance_of_point
    assert owner.shape == (len(cloud),) and owner.dtype == np.int32
    for instance in prepared.instances:
        low, high = BOXES[instance.class_id]
        inside = ((cloud.xyz > low + 0.02) & (cloud.xyz < high + 0.02) & (cloud.xyz[:, 2:] > 0.1)).all(axis=1)
        own = owner == instance.id
        assert inside.sum() > 20
        assert own[inside].mean() > 0.9
        assert (cloud.class_id[own] == instance.class_id).all()
    assert not owner[cloud.class_id == WALL_ID].any()


def test_training_targets_match_the_masks(prepared: PreparedLift) -> None:
    channels = prepared.scene.channels
    assert channels.class_ids == (1, 2, 3, 5)  # no view looks up
    assert set(channels.slot_ids[:2]) == {1, 2} and channels.slot_ids[2:] == (NO_OBJECT, SPARE, SPARE)
    assert [channels.class_of_slot[slot] for slot in channels.instance_slots] == [
        {one.id: one.class_id for one in prepared.instances}[number] for number in channels.shown_ids
    ]
    for target in prepared.targets:
        shape = (target.camera.height, target.camera.width)
        assert target.photo.values.shape == (*shape, 3) and target.things.row.shape == shape
        assert target.pseudo is None and target.semantic is target.projected
        assert (target.projected >= 0).float().mean() > 0.95
        matched, projected = target.matched.numpy(), target.projected.numpy()
        things = {channels.class_ids.index(CHAIR_ID), channels.class_ids.index(CABINET_ID)}
        owned = (matched == 0) | (matched == 1)
        assert set(projected[owned].tolist()) <= things
        # One instance, one class: the slots tell chair and cabinet apart.
        assert {len(set(projected[matched == slot].tolist())) for slot in (0, 1)} <= {0, 1}
        # What is known to be no object's is taught to be so; the unknown is taught nothing.
        assert ((matched == channels.slot_ids.index(NO_OBJECT)) == ((projected >= 0) & ~owned)).all()


def test_nearly_all_anchors_start_with_a_class(prepared: PreparedLift) -> None:
    anchors = prepared.scene.anchors
    assert (anchors.initial_class > 0).float().mean() > 0.95
    assert set(anchors.initial_class.tolist()) <= {0, 1, 2, 3, 5}
    assert not anchors.level.any()


def test_the_smallest_instances_are_left_out_with_a_warning(tmp_path: Path) -> None:
    views, classes = views_of(tmp_path / "scene")
    one = prepared_for(views, classes, replace(TINY, most_instances=1), tmp_path)
    assert [instance.id for instance in one.instances] == [1]
    assert set(one.instance_of_point.tolist()) == {0, 1}
    (told,) = warnings_in(tmp_path / "events.jsonl")
    assert told == "1 instance is left out, the smallest of 2: at most 1 are kept, --set most_instances=2 keeps all"
    both = prepared_for(views, classes, replace(TINY, most_instances=2), tmp_path)
    (smallest, largest) = sorted(both.instances, key=lambda each: each.pixels)
    assert smallest.pixels < largest.pixels and one.instances[0].class_id == largest.class_id


def test_lifting_differently_than_requested_gives_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views, classes = views_of(tmp_path / "scene")
    monkeypatch.setattr(preparation, "views_are_sparse", lambda views, options: True)
    prepared_for(views, classes, replace(TINY, neighbours=2, most_points=500), tmp_path)
    said = (tmp_path / "events.jsonl").read_text()
    assert "overlap too little" in said and "not every 10.0 cm" in said


def test_a_scene_of_the_size_of_a_flat_gives_no_warning_about_its_size(tmp_path: Path) -> None:
    views, classes = views_of(tmp_path / "scene")
    flat = prepared_for(views, classes, replace(TINY, most_points=1500), tmp_path)
    assert flat.cloud.spacing > 1.3 * TINY.voxel_size / 2
    assert "large" not in (tmp_path / "events.jsonl").read_text()


def test_the_instance_channels_always_include_one_for_no_object() -> None:
    assert label_channels((1, 5), [], replace(TINY, instance_slots=3)).slot_ids == (NO_OBJECT, *[SPARE] * 3)
    found = [SceneObject(number, (), CHAIR_ID) for number in (1, 2, 3)]
    channels = label_channels((1, 5), found, replace(TINY, instance_slots=2))
    assert channels.slot_ids == (1, 2, 3, NO_OBJECT) and channels.class_of_slot == (*[CHAIR_ID] * 3, 0)
    assert label_channels((1, 5), found, replace(TINY, one_class_an_object=False)).class_of_slot == ()


def test_every_mask_segment_gets_its_class_and_object(tmp_path: Path) -> None:
    views, classes = views_of(tmp_path / "scene")
    prepared = prepared_for(views, classes, TINY, tmp_path)
    labels = labels_of(prepared.cloud, prepared.instances)
    assert prepared.label_maps is not None
    for view, label_map in zip(views, prepared.label_maps, strict=True):
        true = view.mask.class_map()
        assert (labels.classes(label_map) == true).mean() > 0.98
        assert ((labels.objects(label_map) > 0) == np.isin(true, [CHAIR_ID, CABINET_ID])).mean() > 0.98
    boxes = prepared_for(views, classes, replace(TINY, objects="boxes"), tmp_path)
    assert boxes.label_maps is None


def test_holes_of_the_depth_get_points_but_are_not_trained_on(tmp_path: Path) -> None:
    """A dark patch of the floor: its surface is placed, but what the sensor did not see is not trained on."""
    views, classes = views_of(tmp_path / "scene")
    hole = (slice(36, 46), slice(4, 60))
    holed = [replace(view, depth=view.depth.copy()) for view in views]
    for view in holed:
        view.depth[hole] = 0
    sizes = {}
    for fill in (True, False):
        prepared = prepared_for(holed, classes, replace(TINY, fill_holes=fill), tmp_path)
        assert all(not target.depth.numpy()[hole].any() for target in prepared.targets)
        sizes[fill] = len(prepared.cloud)
    whole = len(prepared_for(views, classes, TINY, tmp_path).cloud)
    assert sizes[False] < sizes[True] and sizes[True] > 0.97 * whole
