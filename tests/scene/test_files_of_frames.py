"""Which mask belongs to which frame, whatever its program added to the name, and where it was put."""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from engine.scene import open_scene
from tests.scene.formats.room import write_grey
from tests.scene.formats.test_nerfstudio import write_scene
from tests.scene.mask_formats.labelled_room import Truth, check_on_room, write_frames
from tests.tiny_scene import write_tiny_scene


def write_labels(folder: Path, rename: Callable[[str], str]) -> list[Truth]:
    scene, truths = write_frames(folder)
    (scene / "masks").mkdir()
    for truth in truths:
        write_grey(scene / "masks" / "a.png", truth.semantic.astype(np.uint8))
        (scene / "masks" / "a.png").rename(scene / "masks" / rename(truth.name))
    return truths


@pytest.mark.parametrize(
    "name", ["{}.png", "{}.PNG", "{}.jpg.png", "{}_pred.png", "mask-{}.png", "room_{}_gtFine_labelIds.png"]
)
def test_what_a_program_adds_to_all_names_is_left_out(tmp_path: Path, name: str) -> None:
    truths = write_labels(tmp_path, name.format)
    (tmp_path / "masks" / "legend.png").write_bytes((tmp_path / "masks" / name.format("0000")).read_bytes())
    check_on_room(open_scene(tmp_path, classes="reduced", mask_format="palette"), truths, things=frozenset())


def test_names_of_macos_are_those_of_other_systems(tmp_path: Path) -> None:
    """ü as u and two dots, and as one letter, in files, in splits.json and in COCO's table."""
    write_tiny_scene(tmp_path, frames=6, splits={"train": ["0000", "0001", "0002", "0003"], "test": ["0004", "0005"]})
    table = tmp_path / "panoptic.json"
    for folder, form in (("color", "NFD"), ("depth", "NFC"), ("pose", "NFD"), ("panoptic", "NFD")):
        for path in [*(tmp_path / folder).iterdir()]:
            path.rename(path.with_name(unicodedata.normalize(form, f"Küche_{path.name}")))
    for path in (table, tmp_path / "splits.json"):
        path.write_text(path.read_text().replace('"00', '"Küche_00'))
    scene = open_scene(tmp_path)
    assert len(scene.frames) == 6 and len(scene.test_frames) == 2 and scene.has_masks and scene.has_depth
    assert scene.frames[0].name == "Küche_0000" and scene.frames[0].mask().segments


def write_rig(tmp_path: Path, cameras: tuple[str, str], mask: Callable[[int], np.ndarray]) -> None:
    """Pictures and masks in a folder for each of two cameras, which see every second frame."""
    write_scene(tmp_path)
    table = tmp_path / "transforms.json"
    content = json.loads(table.read_text())
    for n, frame in enumerate(sorted(content["frames"], key=lambda frame: int(frame["file_path"][15:-4]))):
        old, name = tmp_path / frame["file_path"], f"{cameras[n % 2]}/{n // 2:06d}.png"
        (tmp_path / "images" / name).parent.mkdir(exist_ok=True)
        old.rename(tmp_path / "images" / name)
        frame["file_path"] = f"images/{name}"
        write_grey(tmp_path / "masks" / name, mask(n))
    table.write_text(json.dumps(content))


def labels_of(number: int) -> np.ndarray:
    labels = np.full((48, 64), number + 1, np.uint8)
    labels[:9], labels[:, :9] = 20, 30
    return labels


CAMERAS = [("front", "back"), ("0", "1")]


@pytest.mark.parametrize("cameras", CAMERAS)
def test_masks_of_a_rig_lie_in_a_folder_for_each_camera(tmp_path: Path, cameras: tuple[str, str]) -> None:
    write_rig(tmp_path, cameras, labels_of)
    scene = open_scene(tmp_path, classes="nyu40:1-40")
    assert len(scene.frames) == 6
    for frame in scene.frames:
        _, camera, number = frame.name.split("_")
        label = 2 * int(number) + cameras.index(camera) + 1
        assert scene.classes[frame.mask().class_map()[-1, -1]].id == label
