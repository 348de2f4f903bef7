"""The second floor's program, on a made-up folder with the names of Robot-Indoor-Navigation-System's."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from engine.scene import open_scene
from tests.sample.conftest import Make, Refused
from tests.tiny_scene import (
    CABINET,
    CABINET_ID,
    CEILING_ID,
    CHAIR,
    CHAIR_ID,
    FLOOR_ID,
    ROOM,
    WALL_ID,
    TinyView,
    tiny_pose,
    trace_view,
)

PROGRAM = "second_floor.py"
SIZE = (512, 512)
FRAMES = 7
LENS = np.array([[256.0, 0.0, 256.0], [0.0, 256.0, 256.0], [0.0, 0.0, 1.0]])
LAMP_ID = 7
CLASSES = {
    WALL_ID: ("wall", (9, 9, 9)),
    FLOOR_ID: ("floor", (200, 0, 0)),
    CABINET_ID: ("cabinet", (0, 200, 0)),
    CHAIR_ID: ("chair", (0, 0, 200)),
    LAMP_ID: ("lamp", (7, 7, 0)),
    CEILING_ID: ("ceiling", (0, 9, 9)),
}
"""Names, and colours in pictures of classes."""
UNKNOWN = (255, 255, 255)
WALL, FLOOR, CEILING, UNDEFINED, LAMP, WIDE_CABINET, SMALL_CABINET = range(1, 8)
ARMCHAIR = 256 + LAMP
"""Its id in 8 bits is the lamp's, so the pictures of classes say lamp."""
CHAIR_TWICE, CHAIR_SPECK, NOTHING_KNOWN = np.s_[:30, :30], np.s_[:5, 40:45], np.s_[:30, 60:90]
"""Parts of the picture's upper edge where the network sees something else. The truth is unknown in the last one."""


def view_of(index: int) -> TinyView:
    return trace_view(tiny_pose(index, FRAMES), LENS, SIZE)


def upright(number: int, box: NDArray[np.float64]) -> dict[str, object]:
    abb = {"center": box.mean(0).tolist(), "sizes": (box[1] - box[0]).tolist()}
    orientation = {"rotation": [0, 0, 0, 1], "translation": [0, 0, 0]}
    return {"id": number, "oriented_bbox": {"abb": abb, "orientation": orientation}}


def turned(number: int, box: NDArray[np.float64]) -> dict[str, object]:
    """The same box in axes that are turned by a quarter about z."""
    x, y, z = (box[1] - box[0]).tolist()
    orientation = {"rotation": [0, 0, 0.5**0.5, 0.5**0.5], "translation": box.mean(0).tolist()}
    return {
        "id": number,
        "oriented_bbox": {"abb": {"center": [0, 0, 0], "sizes": [y, x, z]}, "orientation": orientation},
    }


def write_info(path: Path) -> None:
    """The wide cabinet's box holds the small one's; the lamp is in another room."""
    label_of = {WALL: WALL_ID, FLOOR: FLOOR_ID, CEILING: CEILING_ID, LAMP: LAMP_ID, ARMCHAIR: CHAIR_ID}
    label_of |= dict.fromkeys((SMALL_CABINET, WIDE_CABINET), CABINET_ID)
    objects = [
        turned(ARMCHAIR, CHAIR),
        *(upright(number, ROOM) for number in (WALL, FLOOR, CEILING, UNDEFINED, WIDE_CABINET)),
        turned(SMALL_CABINET, CABINET),
        upright(LAMP, ROOM + 20),
    ]
    info = {
        "classes": [{"id": number, "name": name} for number, (name, _) in CLASSES.items()],
        "id_to_label": [label_of.get(number, -1) for number in range(ARMCHAIR + 1)],
        "objects": objects,
    }
    path.write_text(json.dumps(info))


def painted(classes: NDArray[np.integer]) -> NDArray[np.uint8]:
    picture = np.zeros((*classes.shape, 3), np.uint8)
    for number, (_, colour) in CLASSES.items():
        picture[classes == number] = colour
    return picture


def write_pictures(folder: Path, number: int, **pictures: NDArray[np.generic]) -> None:
    for kind, pixels in pictures.items():
        (folder / kind).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / kind / f"{number}.png"), pixels)


def write_frame(folder: Path, index: int) -> None:
    view = view_of(index)
    stored = np.where(view.semantic == CHAIR_ID, LAMP_ID, view.semantic)
    stored[NOTHING_KNOWN] = 0
    seen = painted(view.semantic)
    seen[CHAIR_TWICE] = seen[CHAIR_SPECK] = CLASSES[CHAIR_ID][1]
    seen[NOTHING_KNOWN] = UNKNOWN
    depth = np.round(view.depth / 10 * 65535).astype(np.uint16)
    pictures = {"semantic": stored.astype(np.uint8), "semantic_gt": painted(stored), "semantic_2": seen}
    write_pictures(folder, index + 1, rgb=view.colour, depth=depth, **pictures)


def told_pose(pose: NDArray[np.float64]) -> list[float]:
    """x y z qw qx qy qz with OpenGL's axes and y up, for a pose with OpenCV's axes and z up."""
    y_up = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    x, y, z, w = Rotation.from_matrix(y_up @ pose[:3, :3] @ np.diag([1, -1, -1])).as_quat().tolist()
    return [*(y_up @ pose[:3, 3]).tolist(), w, x, y, z]


@pytest.fixture(scope="module")
def both_floors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Chairs are among the true classes of the first floor only. Only for reading."""
    folder = tmp_path_factory.mktemp("data") / "Semantic-Segmentation"
    floors = folder / "Data_collection"
    for index in range(FRAMES):
        write_frame(floors / "second_floor", index)
    chairs = np.full(SIZE, CHAIR_ID, np.uint8)
    write_pictures(floors / "first_floor", 1, semantic=chairs, semantic_gt=painted(chairs))
    np.savetxt(floors / "second_floor/GT_Pose.txt", [told_pose(tiny_pose(index, FRAMES)) for index in range(FRAMES)])
    write_info(folder / "info_semantic.json")
    return folder.parent


@pytest.fixture
def data(both_floors: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(both_floors, tmp_path / "data"))


def test_it_makes_a_scene_that_can_be_lifted(data: Path, tmp_path: Path, make: Make) -> None:
    said = make(data, tmp_path / "floor")
    assert said.returncode == 0 and "4 frames" in said.stdout, said.stderr
    scene = open_scene(tmp_path / "floor", None, "z")
    assert [frame.name for frame in scene.frames] == ["0000", "0001", "0002", "0003"]
    assert [frame.name for frame in scene.test_frames] == ["0003"]
    frame, view = scene.frames[1], view_of(2)
    np.testing.assert_allclose(frame.camera.camera_to_world, tiny_pose(2, FRAMES), atol=1e-9)
    np.testing.assert_allclose(frame.camera.K, LENS)
    np.testing.assert_allclose(frame.read_depth(None), view.depth, atol=0.001)
    photo = cv2.imread(str(tmp_path / "floor/color/0001.jpg"))
    assert np.abs(photo.astype(int) - view.colour).mean() < 3


def test_masks_are_what_the_network_saw(data: Path, tmp_path: Path, make: Make) -> None:
    assert make(data, tmp_path / "floor", "--every", "3").returncode == 0
    mask = open_scene(tmp_path / "floor", None, "z").frames[1].read_mask(None)
    expected = view_of(3).semantic
    expected[CHAIR_TWICE] = CHAIR_ID
    expected[CHAIR_SPECK] = expected[NOTHING_KNOWN] = 0
    assert (mask.class_map() == expected).mean() > 0.999, "but for the corners of things"
    table = json.loads((tmp_path / "floor/panoptic.json").read_text())
    segments = [segment["category_id"] for segment in table["annotations"][1]["segments_info"]]
    assert segments == [WALL_ID, FLOOR_ID, CABINET_ID, CHAIR_ID, CHAIR_ID]
    things = {category["name"]: category["isthing"] for category in table["categories"]}
    assert things == {"wall": 0, "floor": 0, "cabinet": 1, "chair": 1, "lamp": 1, "ceiling": 0}


def test_ground_truth_is_the_smallest_box_around_a_point(data: Path, tmp_path: Path, make: Make) -> None:
    assert make(data, tmp_path / "floor", "--every", "3").returncode == 0
    semantic = view_of(3).semantic
    semantic[NOTHING_KNOWN] = 0
    true = {
        name: cv2.imread(str(tmp_path / f"floor/gt/{name}/0001.png"), cv2.IMREAD_UNCHANGED)
        for name in ("semantic", "instance")
    }
    assert (true["semantic"] == semantic).all()
    objects = {0: 0, WALL_ID: WALL, FLOOR_ID: FLOOR, CABINET_ID: SMALL_CABINET, CHAIR_ID: ARMCHAIR}
    for class_id, number in objects.items():
        assert set(true["instance"][semantic == class_id].tolist()) == {number}


def test_bad_input_is_one_line(data: Path, tmp_path: Path, refused: Refused) -> None:
    floors = data / "Semantic-Segmentation/Data_collection"
    (tmp_path / "empty").mkdir()

    refused("GT_Pose.txt", tmp_path / "empty", tmp_path / "out")
    refused("already", data, data)
    (floors / "second_floor/depth/3.png").unlink()
    refused("depth/3.png", data, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    cv2.imwrite(str(floors / "second_floor/depth/3.png"), np.zeros((512, 512), np.uint8))
    refused("depth/3.png", data, tmp_path / "out")
    (floors / "first_floor/semantic/1.png").unlink()
    refused("first_floor/semantic", data, tmp_path / "out")
    (data / "Semantic-Segmentation/info_semantic.json").write_text('{"classes": []}')
    refused("info_semantic.json", data, tmp_path / "out")
    (floors / "second_floor/GT_Pose.txt").write_text("1 2 3\n")
    refused("GT_Pose.txt", data, tmp_path / "out")
