"""Every bad input gets one clear line: what is wrong, which file, what to do."""

import json
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from engine.scene import open_scene
from tests.raises_key import raises_key
from tests.scene.refusing import check_scene
from tests.tiny_scene import write_tiny_scene


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_scene(tmp_path_factory.mktemp("good"), frames=6)


@pytest.fixture
def folder(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "scene"))


def line(folder: Path) -> str:
    """The error's key, its place without the folder of this test, and what it quotes."""
    with raises_key("*") as caught:
        check_scene(open_scene(folder))
    key, where, text = caught.value.key, caught.value.where, str(caught.value)
    assert "\n" not in text
    where = where.replace(f"{folder}/", "").replace(str(folder), "SCENE")
    return " ".join([key, where, *re.findall(r'"(\w+)"', text)])


Spoil = Callable[[Path], object]


def remove(name: str) -> Spoil:
    return lambda folder: shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()


def change(name: str, edit: Callable[[bytes], bytes]) -> Spoil:
    return lambda folder: (folder / name).write_bytes(edit((folder / name).read_bytes()))


def write(name: str, content: str | bytes) -> Spoil:
    data = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / name).write_bytes(data)


def of_four(spoil: Callable[[str], Spoil]) -> Spoil:
    """The same for four frames of six: of fewer, frames are left out."""
    return lambda folder: [spoil(f"000{number}")(folder) for number in range(1, 5)]


def image(name: str, pixels: Any) -> Spoil:
    return lambda folder: cv2.imwrite(str(folder / name), pixels)


def pose(edit: Callable[[np.ndarray], np.ndarray], name: str = "0001") -> Spoil:
    path = f"pose/{name}.txt"
    return lambda folder: np.savetxt(folder / path, edit(np.loadtxt(folder / path)))


def table(edit: Callable[[dict[str, Any]], object]) -> Spoil:
    def edited(data: bytes) -> bytes:
        content = json.loads(data)
        edit(content)
        return json.dumps(content).encode()

    return change("panoptic.json", edited)


def segment(**values: object) -> Spoil:
    return table(lambda content: content["annotations"][1]["segments_info"][2].update(values))


def splits(content: object) -> Spoil:
    return write("splits.json", json.dumps(content))


def halved(data: bytes) -> bytes:
    return data[: len(data) // 2]


def damaged(data: bytes) -> bytes:
    return halved(data) + bytes([data[len(data) // 2] ^ 0xFF]) + data[len(data) // 2 + 1 :]


def metres(folder: Path) -> None:
    for path in (folder / "depth").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.round(depth / 1000.0).astype(np.uint16))


def apart(folder: Path) -> None:
    for index in range(6):
        pose(lambda matrix: matrix + np.eye(4, k=3) * 100.0 * index, f"000{index}")(folder)  # noqa: B023


def empty_masks(folder: Path) -> None:
    for path in (folder / "panoptic").iterdir():
        image(f"panoptic/{path.name}", np.zeros((48, 64, 3), np.uint8))(folder)
    table(lambda content: [each.update(segments_info=[]) for each in content["annotations"]])(folder)


def poses(content: str | bytes) -> Spoil:
    return of_four(lambda name: write(f"pose/{name}.txt", content))


PALETTE_PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x40\0\0\0\x30\x08\x03\0\0\0\0\0\0\0IEND\xaeB`\x82"
"""As much of a 64x48 PNG with a colour table as its header needs."""

CASES: dict[str, Spoil] = {
    "no folder": lambda folder: shutil.rmtree(folder),
    "no color": remove("color"),
    "no depth": remove("depth"),
    "no pose": remove("pose"),
    "no intrinsics file": remove("intrinsic/intrinsic_color.txt"),
    "no masks": remove("panoptic.json"),
    "no colour image": lambda folder: [path.unlink() for path in (folder / "color").iterdir()],
    "frames without depth": of_four(lambda name: remove(f"depth/{name}.png")),
    "frames without pose": of_four(lambda name: remove(f"pose/{name}.txt")),
    "frames without mask entry": of_four(lambda name: table(lambda content: content["annotations"].pop(1))),
    "frames without mask image": of_four(lambda name: remove(f"panoptic/{name}.png")),
    "a link to nowhere": lambda folder: ((path := folder / "color/0001.png").unlink(), path.symlink_to("gone.png")),
    "two colour images of a frame": lambda folder: shutil.copy(folder / "color/0001.png", folder / "color/0001.jpg"),
    # Numbers
    "NaN in poses": of_four(partial(pose, lambda matrix: matrix + np.eye(4, k=3) * np.nan)),
    "a pose far away": pose(lambda matrix: matrix + np.eye(4, k=3) * 1e300),
    "words in poses": poses("1 0 0 0\n0 1 0 zero\n0 0 1 0\n0 0 0 1"),
    "poses of three rows": poses("1 0 0 0\n0 1 0 0\n0 0 1 0\n"),
    "binary poses": poses(b"\x93NUMPY\xff\xfe"),
    "a transposed pose": pose(np.transpose),
    "a scaled pose": pose(lambda matrix: matrix @ np.diag([1.5, 1.5, 1.5, 1.0])),
    "a mirrored pose": pose(lambda matrix: matrix @ np.diag([-1.0, 1.0, 1.0, 1.0])),
    "a sheared pose": pose(lambda matrix: matrix + 0.2 * np.outer([1, 0, 0, 0], [0, 1, 0, 0])),
    "NaN in the intrinsics": write("intrinsic/intrinsic_color.txt", "50 0 nan\n0 50 24\n0 0 1"),
    "negative fy": write("intrinsic/intrinsic_color.txt", "50 0 32\n0 -50 24\n0 0 1"),
    "skew": write("intrinsic/intrinsic_color.txt", "50 3 32\n0 50 24\n0 0 1"),
    "intrinsics of larger images": write("intrinsic/intrinsic_color.txt", "500 0 320\n0 500 240\n0 0 1"),
    # Sizes
    "depth of another shape": image("depth/0001.png", np.full((48, 48), 999, np.uint16)),
    "mask of another shape": image("panoptic/0001.png", np.zeros((48, 48, 3), np.uint8)),
    "ground truth of another shape": image("gt/semantic/0001.png", np.zeros((48, 48), np.uint8)),
    "colour of another shape": image("color/0001.png", np.zeros((64, 48, 3), np.uint8)),
    # Depth
    "8-bit depth": image("depth/0001.png", np.full((48, 64), 99, np.uint8)),
    "coloured depth": of_four(lambda name: image(f"depth/{name}.png", np.full((48, 64, 3), (99, 99, 98), np.uint16))),
    "all-zero depth": of_four(lambda name: image(f"depth/{name}.png", np.zeros((48, 64), np.uint16))),
    "depth in metres": metres,
    # Images
    "an empty image": of_four(lambda name: write(f"color/{name}.png", b"")),
    "a cut-off image": of_four(lambda name: change(f"color/{name}.png", halved)),
    "a damaged depth": of_four(lambda name: change(f"depth/{name}.png", damaged)),
    "not an image": of_four(lambda name: write(f"color/{name}.png", "GIF89a, honestly")),
    "palette ground truth": write("gt/semantic/0001.png", PALETTE_PNG),
    # JSON
    "an empty JSON": write("panoptic.json", ""),
    "a JSON list": write("panoptic.json", "[]"),
    "no categories": table(lambda content: content.pop("categories")),
    "empty categories": table(lambda content: content["categories"].clear()),
    "an annotation of a wrong type": table(lambda content: content.update(annotations=["a"])),
    "no isthing": table(lambda content: content["categories"][0].pop("isthing")),
    "a colour of a wrong type": table(lambda content: content["categories"][0].update(color=[1, 2, 300])),
    "a category of two lines": table(lambda content: content["categories"][0].update(name="wall\nfloor")),
    "a category twice": table(lambda content: content["categories"].append(content["categories"][0])),
    "a negative category": table(lambda content: content["categories"][0].update(id=-1)),
    "an annotation twice": table(lambda content: content["annotations"].append(content["annotations"][0])),
    "no file name": table(lambda content: content["annotations"][1].pop("file_name")),
    "a file name that climbs": table(lambda content: content["annotations"][1].update(file_name="../color/0001.png")),
    "a Windows file name": table(lambda content: content["annotations"][1].update(file_name="C:\\masks\\0001.png")),
    "segments of a wrong type": table(lambda content: content["annotations"][1].update(segments_info="none")),
    "an unknown category": segment(category_id=77),
    "a segment id of 0": segment(id=0),
    "a duplicate segment id": segment(id=5),
    "a score in per cent": segment(score=85),
    "an infinite number": change(
        "panoptic.json", lambda data: data.replace(b'"category_id": 3', b'"category_id": 1e999')
    ),
    "ids in the PNG that the JSON lacks": table(
        lambda content: [each["segments_info"].pop(2) for each in content["annotations"][1:5]]
    ),
    "empty masks": empty_masks,
    # Splits
    "unknown names in splits.json": splits({"train": ["0000", "9999"], "test": ["0001.png"]}),
    "a frame in both splits": splits({"train": ["0000", "0001"], "test": ["0001"]}),
    "a frame twice in a split": splits({"train": ["0000", "0000"], "test": ["0001"]}),
    "nothing to train on": splits({"train": [], "test": ["0001"]}),
    "splits without test": splits({"train": ["0000"]}),
    "a split of numbers": splits({"train": [0], "test": []}),
    # Geometry
    "no overlap": apart,
    "all poses lost": lambda folder: [write(f"pose/000{i}.txt", "-inf -inf -inf -inf\n" * 4)(folder) for i in range(6)],
}


EXPECTED = dict(
    entry.split(": ", 1) for entry in Path(__file__).with_name("bad_input.txt").read_text("utf-8").splitlines()
)


@pytest.mark.parametrize("name", CASES)
def test_every_kind_of_bad_scene_gives_a_one_line_error(name: str, folder: Path) -> None:
    CASES[name](folder)
    assert line(folder) == EXPECTED[name]


def test_a_good_scene_is_accepted(folder: Path) -> None:
    assert check_scene(open_scene(folder)) == ()
