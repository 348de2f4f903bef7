"""Label images, Panoptic Lifting's among them."""

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from engine.scene import Scene, open_scene, open_scene_to_lift
from engine.scene_source import SceneSource
from tests.raises_key import raises_key
from tests.scene.mask_formats.labelled_room import (
    NAMES,
    Truth,
    check_on_room,
    mask_of,
    write_frames,
    write_masked_frames,
)
from tests.scene.mask_formats.test_tracks import palette_png
from tests.scene.refusing import check_scene, refuses
from tests.tiny_scene import write_tiny_scene

NYU = {1: 1, 2: 2, 3: 3, 5: 5, 13: 22}
"""The room's classes in NYU40."""
ADE = {1: 0, 2: 3, 3: 10, 5: 19, 13: 5}
THINGS = frozenset({"cabinet", "chair"})


def in_table(truth: Truth, table: dict[int, int]) -> np.ndarray:
    return np.vectorize(table.__getitem__)(truth.semantic)


def write_pairs(folder: Path, kinds: tuple[str, str]) -> list[Truth]:
    scene, truths = write_frames(folder)
    for truth in truths:
        for kind, values in zip(kinds, (in_table(truth, NYU), truth.instance), strict=True):
            (scene / "masks" / kind).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(scene / "masks" / kind / f"{truth.name}.png"), values.astype(np.uint8))
    return truths


def test_label_image_pairs_need_a_class_table(tmp_path: Path) -> None:
    write_pairs(tmp_path, ("semantic_class", "semantic_instance"))
    refuses("no-class-names", tmp_path)


@pytest.mark.parametrize(
    ("frame", "kinds", "other"),
    [
        ("rgb_{}", ("semantic_class_{}", "semantic_instance_{}"), "vis_sem_class_{}"),  # Semantic-NeRF, vMAP
        ("test.rgba.{:05d}", ("test.sem.{:05d}", "test.{}"), "test.depth.{:05d}"),  # habitat-sim
        ("frame_{:04d}", ("{}_mask", "{}"), "{}_color"),
    ],
)
def test_masks_are_paired_by_frame_number(tmp_path: Path, frame: str, kinds: tuple[str, str], other: str) -> None:
    truths = write_pairs(tmp_path, ("semantic_class", "semantic_instance"))
    for part in ("color", "depth", "pose"):
        for i, path in enumerate(sorted((tmp_path / part).iterdir())):
            path.rename(path.with_name(frame.format(i) + path.suffix))
    folders = [tmp_path / "masks" / kind for kind in ("semantic_class", "semantic_instance")]
    for i in range(3):
        for folder, name in zip(folders, kinds, strict=True):
            (folder / f"{i:04d}.png").rename(folder / f"{name.format(i)}.png")
        cv2.imwrite(str(folders[0] / f"{other.format(i)}.png"), np.zeros((48, 64, 3), np.uint8))
    scene = open_scene(tmp_path, classes="nyu40")
    check_on_room(scene, truths, NAMES, THINGS)
    wanted = f"{frame.format(0)} has semantic_class/{kinds[0].format(0)}.png"
    assert any("not named like their frames" in warning and wanted in warning for warning in scene.warnings)


def test_thing_pixels_without_an_instance_may_be_several_objects(tmp_path: Path) -> None:
    write_pairs(tmp_path, ("semantic", "instance"))
    cv2.imwrite(str(tmp_path / "masks" / "instance" / "0000.png"), np.zeros((48, 64), np.uint8))
    segments = mask_of(open_scene(tmp_path, classes="nyu40")).segments
    assert [one.is_group for one in segments if one.class_id in (3, 5)] == [True, True]
    assert not any(one.is_thing for one in segments)


def write_palettes(folder: Path) -> list[Truth]:
    """255 is void, as in Pascal VOC; ADE20K's 0 is a wall."""
    masks, truths = write_masked_frames(folder)
    for truth in truths:
        values = in_table(truth, ADE)
        values[:4], truth.semantic[:4], truth.instance[:4] = 255, 0, 0
        (masks / f"{truth.name}.png").write_bytes(palette_png(values))
    return truths


def write_arrays(folder: Path, save: Any) -> list[Truth]:
    masks, truths = write_masked_frames(folder)
    for truth in truths:
        save(masks / truth.name, truth)
    return truths


def write_classes(folder: Path) -> list[Truth]:
    def save(path: Path, truth: Truth) -> None:
        np.savez_compressed(f"{path}.npz", semantic=in_table(truth, NYU).astype(np.int64), instance=truth.instance)

    return write_arrays(folder, save)


def write_probabilities(folder: Path, is_last: bool = False) -> list[Truth]:
    """Channels 0..40 of NYU40 with 0 for void; the winner has 0.6, one other the rest."""

    def save(path: Path, truth: Truth) -> None:
        shares = np.zeros((41, 48, 64), np.float32)
        np.put_along_axis(shares, in_table(truth, NYU)[None], 0.6, 0)
        shares[40] += 0.4
        np.save(f"{path}.npy", np.moveaxis(shares, 0, -1) if is_last else shares)

    return write_arrays(folder, save)


def test_probability_arrays_may_have_classes_on_the_last_axis(tmp_path: Path) -> None:
    truths = write_probabilities(tmp_path, is_last=True)
    scene = open_scene(tmp_path, classes="nyu40")
    check_on_room(scene, truths, NAMES, frozenset())
    assert [one.score for one in mask_of(scene).segments] == pytest.approx([0.6] * len(mask_of(scene).segments))


def header_of(shape: tuple[int, ...]) -> bytes:
    """An .npy that claims to be large, without its numbers."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<i4", "fortran_order": False, "shape": shape})
    return file.getvalue()


def test_an_unknown_mask_format_is_answered_with_the_known_ones(tmp_path: Path) -> None:
    write_masked_frames(tmp_path)
    refuses("no-known-masks coco arrays", tmp_path)
    refuses("unknown-format yolo coco", tmp_path, mask_format="yolo")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path / "scene", frames=6, size=(32, 24), masks="panoptic_lifting")


def paint(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), pixels)


def classes_seen(scene: Scene) -> np.ndarray:
    return scene.frames[1].read_mask(None).class_map()


def test_every_pair_of_class_and_instance_is_a_segment(folder: Path) -> None:
    frame = open_scene(folder).frames[1]
    mask = frame.read_mask(None)
    truth = cv2.imread(str(folder / "gt" / "semantic" / "0001.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask.class_map(), truth)
    assert [segment.id for segment in mask.segments] == list(range(1, len(mask.segments) + 1))
    assert {s.class_id: s.is_thing for s in mask.segments} == {1: False, 2: False, 3: False, 5: True}
    assert not any(segment.is_group for segment in mask.segments), "stuff is no group of things"
    assert mask.ids.min() > 0 and check_scene(open_scene(folder)) == ()


def test_two_chairs_in_label_images_are_two_segments(folder: Path) -> None:
    semantic, instance = np.full((24, 32), 5, np.uint16), np.zeros((24, 32), np.uint16)
    semantic[:4] = 0
    instance[4:, :10], instance[4:, 10:20] = 200, 201
    paint(folder / "m2f_semantics" / "0001.png", semantic)
    paint(folder / "m2f_instance" / "0001.png", instance)
    mask = open_scene(folder).frames[1].read_mask(None)
    assert not mask.ids[:4].any()
    found = [(s.class_id, s.is_thing, s.is_group) for s in mask.segments]
    assert found == [(5, False, True), (5, True, False), (5, True, False)], "instance 0 may be several chairs"
    assert (mask.ids[5, 25], mask.ids[5, 0], mask.ids[5, 15]) == (1, 2, 3)


def test_panoptic_liftings_masks_without_augmentation_can_be_used(folder: Path) -> None:
    for kind in ("semantics", "instance"):
        (folder / f"m2f_{kind}").rename(folder / f"m2f_notta_{kind}")
    assert set(classes_seen(open_scene(folder)).ravel()) >= {1, 2}
    for index in range(6):
        paint(folder / "m2f_semantics" / f"{index:04d}.png", np.full((24, 32), 4, np.uint8))
        paint(folder / "m2f_instance" / f"{index:04d}.png", np.ones((24, 32), np.uint8))
    both = open_scene(folder)
    assert (classes_seen(both) == 4).all() and "name m2f_notta_semantics" in both.warnings[0]
    named = open_scene(folder, masks=folder / "m2f_notta_semantics")
    assert (classes_seen(named) != 4).all() and named.warnings == ()


def test_masks_of_panoptic_lifting_may_lie_in_another_folder(folder: Path, tmp_path: Path) -> None:
    for kind in ("semantics", "instance"):
        (tmp_path / "masks").mkdir(exist_ok=True)
        (folder / f"m2f_{kind}").rename(tmp_path / "masks" / f"m2f_{kind}")
    with raises_key("no-masks"):
        open_scene_to_lift(SceneSource(folder))
    assert len(open_scene(folder, masks=tmp_path / "masks").frames) == 6
    refuses("no-masks", folder, masks=tmp_path / "nowhere")


def test_coco_masks_may_be_given_as_file_or_folder(tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path / "scene", frames=5, size=(32, 24))
    (tmp_path / "masks").mkdir()
    (scene / "panoptic").rename(tmp_path / "masks" / "detector")
    (scene / "panoptic.json").rename(tmp_path / "masks" / "detector.json")
    assert len(open_scene(scene, masks=tmp_path / "masks" / "detector.json").frames) == 5
    (tmp_path / "masks" / "detector").rename(tmp_path / "masks" / "panoptic")
    (tmp_path / "masks" / "detector.json").rename(tmp_path / "masks" / "panoptic.json")
    assert len(open_scene(scene, masks=tmp_path / "masks").frames) == 5
