"""Masks made of a network's queries, frame by frame."""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from engine.scene import ClassLabel, open_scene
from engine.segment import Detection, Job, MadeSegment, begin_job, detections_of, make_masks, merge_queries
from tests.raises_key import raises_key
from tests.scene.refusing import check_scene
from tests.tiny_scene import write_tiny_scene

LABELS = (ClassLabel(0, "wall", False), ClassLabel(1, "chair", True))


@dataclass
class Halves:
    """Calls the left half of every picture a wall, and a part of the right one a chair."""

    name: str = "halves"
    labels: tuple[ClassLabel, ...] = LABELS
    seen: list[tuple[int, ...]] = field(default_factory=list)

    def segment(self, colour: NDArray[np.uint8]) -> tuple[NDArray[np.int32], list[MadeSegment], list[Detection]]:
        self.seen.append(colour.shape)
        ids = np.zeros(colour.shape[:2], np.int32)
        ids[:, : ids.shape[1] // 2] = 1
        ids[4:, -8:] = 70000
        return ids, [MadeSegment(1, 0, 0.9), MadeSegment(70000, 1, 0.75)], [Detection(1, 0.25, ids > 0)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path / "scene", frames=4, size=(32, 24), ground_truth=False, masks="none")


def silent(done: int, frames: int, made: int) -> None:
    pass


def begun(folder: Path, model: str = "halves") -> Job:
    return begin_job(folder, model, open_scene(folder).frames)


def test_masks_made_by_segment_are_found_with_the_scene(folder: Path) -> None:
    network = Halves()
    make_masks(open_scene(folder), begun(folder), network, silent)
    scene = open_scene(folder)
    assert check_scene(scene) == () and len(network.seen) == 4
    assert [(one.id, one.name, one.is_thing) for one in scene.classes.categories] == [
        (1, "wall", False), (2, "chair", True)
    ]  # fmt: skip
    mask = scene.frames[2].mask()
    assert mask.ids[0].tolist() == [1] * 16 + [0] * 16 and mask.ids[9, 30] == 70000
    assert [(one.class_id, one.score) for one in mask.segments] == [(1, 0.9), (2, 0.75)]
    table = json.loads((folder / "panoptic.json").read_text())
    assert table["annotations"][0]["segments_info"][1]["area"] == 20 * 8
    assert begun(folder).is_finished
    over = open_scene(folder, detections=folder / "detections.json").frames[2]
    (layer,) = over.layers()
    assert [(one.class_id, one.score) for one in layer.segments] == [(2, 0.25)]
    assert ((layer.ids > 0) == (mask.ids > 0)).all() and (over.mask().ids == mask.ids).all()
    assert not [*(folder / "panoptic").glob("*.json")][1:], "made_by.json alone is left"


def test_a_stopped_segment_run_continues(folder: Path) -> None:
    def stop(done: int, frames: int, made: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    first, second, told = Halves(), Halves(), list[tuple[int, int, int]]()
    with pytest.raises(KeyboardInterrupt):
        make_masks(open_scene(folder), begun(folder), first, stop)
    assert len(first.seen) == 2 and not open_scene(folder).has_masks
    job = begun(folder)
    assert job.is_begun and not job.is_finished
    make_masks(open_scene(folder), job, second, lambda *counts: told.append(counts))
    assert len(second.seen) == 2 and told == [(1, 4, 0), (2, 4, 0), (3, 4, 1), (4, 4, 2)]
    assert open_scene(folder).has_masks


def test_segment_never_overwrites_other_masks(folder: Path) -> None:
    make_masks(open_scene(folder), begun(folder), Halves(), silent)
    with raises_key("other-masks halves"):
        begun(folder, "another")
    for name in ("panoptic.json", "detections.json", "m2f_semantics", "masks"):
        other = folder.parent / f"with_{name}"
        (other / name).mkdir(parents=True)
        with raises_key(f"has-masks {name}"):
            begin_job(other, "halves", ())
        assert [path.name for path in other.iterdir()] == [name]


def test_segment_makes_masks_again_for_changed_photos(folder: Path) -> None:
    """Their number alone was looked at."""
    job = begun(folder)
    make_masks(open_scene(folder), job, Halves(), silent)
    photo = folder / "color" / "0001.png"
    photo.write_bytes((folder / "color" / "0002.png").read_bytes())
    with raises_key("photos-changed"):
        begun(folder)
    made_by = job.pictures / "made_by.json"
    made_by.write_text('{"model": "halves", "frames": 4}')  # by an earlier version
    assert begun(folder).is_finished


def test_segment_accepts_finished_masks_in_a_read_only_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_masks(open_scene(folder), begun(folder), Halves(), silent)
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # as on a read-only share; root may write anywhere
    assert begun(folder).is_finished
    (folder / "panoptic.json").unlink()
    with raises_key("not-writable scene"):
        begun(folder)


def test_segment_names_a_damaged_frame(folder: Path) -> None:
    def stop(done: int, frames: int, made: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_masks(open_scene(folder), begun(folder), Halves(), stop)
    (folder / "panoptic" / "0002.json").write_text("[")
    with raises_key("foreign-file 0002.json"):
        make_masks(open_scene(folder), begun(folder), Halves(), silent)


def test_segment_without_frames_leaves_no_files(folder: Path) -> None:
    before = sorted(folder.iterdir())
    begun(folder).discard_if_empty()
    assert sorted(folder.iterdir()) == before
    make_masks(open_scene(folder), begun(folder), Halves(), silent)
    begun(folder).discard_if_empty()
    assert open_scene(folder).has_masks, "what was made stays"


STUFF = frozenset({0})
"""Label 0 is a wall, 1 a chair; 2 stands for no object."""


def logits(*shares: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(shares).log()


def strips(*parts: slice) -> torch.Tensor:
    """A mask a query, 4x10 pixels, sure of these columns."""
    masks = torch.full((len(parts), 4, 10), 0.01)
    for mask, part in zip(masks, parts, strict=True):
        mask[:, part] = 0.99
    return masks


def test_segment_joins_stuff_regions_but_not_things() -> None:
    shares = [(0.8, 0.1, 0.1), (0.1, 0.9, 0.0001), (0.6, 0.2, 0.2), (0.1, 0.7, 0.2)]
    ids, found = merge_queries(logits(*shares), strips(slice(0, 2), slice(2, 4), slice(4, 6), slice(6, 8)), STUFF)
    assert ids.dtype == np.int32 and ids[0].tolist() == [1, 1, 2, 2, 1, 1, 3, 3, 0, 0]
    assert [(one.id, one.label) for one in found] == [(1, 0), (2, 1), (3, 1)]
    np.testing.assert_allclose([one.score for one in found], [0.7, 0.9 / 1.0001, 0.7], rtol=1e-5)


def test_segments_hidden_by_others_are_dropped() -> None:
    """Of the second chair only 2 of 4 columns are its own: too little."""
    ids, found = merge_queries(logits((0.1, 0.8, 0.1), (0.1, 0.7, 0.2)), strips(slice(0, 4), slice(2, 6)), STUFF)
    assert ids[0].tolist() == [1, 1, 1, 1, 0, 0, 0, 0, 0, 0] and len(found) == 1


def test_empty_or_uncertain_network_outputs_make_no_segment() -> None:
    ids, found = merge_queries(logits((0.1, 0.1, 0.8), (0.4, 0.35, 0.25)), strips(slice(0, 4), slice(4, 9)), STUFF)
    assert not ids.any() and found == []


def test_uncertain_network_outputs_are_kept_as_detections() -> None:
    shares = logits((0.15, 0.05, 0.8), (0.05, 0.04, 0.91), (0.1, 0.85, 0.05))
    masks = strips(slice(0, 6), slice(0, 2), slice(4, 8))
    found = detections_of(shares, masks)
    shown = [(one.label, round(one.score, 2), int(one.pixels.sum(1)[0])) for one in found]
    assert shown == [(0, 0.15, 6), (1, 0.85, 4)]
