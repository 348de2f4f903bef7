"""Masks that a program numbered, turned, bent or framed otherwise than their pictures."""

import json
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import Camera, load_view, open_scene
from engine.scene.estimated_depth import with_estimated_depth
from engine.scene.formats.lens import of_opencv, undistorted
from engine.scene.frame import SparsePoints
from engine.scene.mask_fit import Pictured, placements
from engine.scene.mask_formats import FoundMask, FoundSegment, MaskSource, StoredMask
from tests.raises_key import raises_key
from tests.scene.formats.room import Lens, look, look_bent, views, write_colour, write_grey
from tests.scene.formats.test_nerfstudio import LENS, write_scene
from tests.tiny_scene import write_tiny_scene

SIZE = (160, 120)


def renamed(scene: Path, rename: Callable[[int], str]) -> Path:
    """The scene with its COCO masks under other names."""
    table = scene / "panoptic.json"
    content = json.loads(table.read_text())
    content.pop("images", None)
    for n, entry in enumerate(content["annotations"]):
        (scene / "panoptic" / entry["file_name"]).rename(scene / "panoptic" / f"new_{n}.png")
        entry["file_name"] = f"new_{n}.png"
    for n, entry in enumerate(content["annotations"]):
        entry["file_name"] = f"{rename(n)}.png"
        (scene / "panoptic" / f"new_{n}.png").rename(scene / "panoptic" / entry["file_name"])
    table.write_text(json.dumps(content))
    return scene


def thinned(scene: Path) -> Path:
    """The scene whose frames have even numbers only, as every second picture of a film has."""
    for folder in ("color", "depth", "pose"):
        for path in sorted((scene / folder).iterdir(), reverse=True):
            path.rename(path.with_stem(f"{2 * int(path.stem):04d}"))
    return scene


@pytest.mark.parametrize(
    ("change", "rename"),
    [
        (lambda scene: scene, lambda n: f"{n + 1:04d}"),
        (lambda scene: scene, lambda n: f"frame_{n + 1:05d}"),
        (thinned, lambda n: f"{n:04d}"),
        (thinned, lambda n: f"mask_{n + 1}"),
    ],
)
def test_masks_numbered_differently_from_frames_are_found(
    tmp_path: Path, change: Callable[[Path], Path], rename: Callable[[int], str]
) -> None:
    usual = open_scene(write_tiny_scene(tmp_path / "usual", frames=14, size=SIZE, ground_truth=False))
    scene = write_tiny_scene(tmp_path / "other", frames=14, size=SIZE, ground_truth=False)
    opened = open_scene(change(renamed(scene, rename)))
    assert any("masks are paired with frames" in warning for warning in opened.warnings)
    for frame, right in zip(opened.frames, usual.frames, strict=True):
        np.testing.assert_array_equal(frame.mask().ids, right.mask().ids)


def test_a_missing_mask_does_not_shift_the_others(tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path, frames=8, size=SIZE, ground_truth=False)
    opened = open_scene(renamed(scene, lambda n: f"{n:04d}" if n else "0008"))  # frame 0 was masked last, as 8
    assert [frame.name for frame in opened.frames] == [f"{n:04d}" for n in range(1, 8)]
    assert not any("paired" in warning for warning in opened.warnings)


def tagged(path: Path, orientation: int) -> None:
    """Give a JPEG the EXIF tag."""
    data = path.read_bytes()
    tiff = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x112, 3, 1, orientation, 0, 0)
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff + data[2:])


@pytest.mark.parametrize(("orientation", "turns"), [(3, 2), (6, -1), (8, 1)])
def test_masks_of_photos_with_exif_rotation_are_turned_to_fit(tmp_path: Path, orientation: int, turns: int) -> None:
    """The network's reader turned the photos; poses and depth are of the stored pixels."""
    scene = write_tiny_scene(tmp_path, frames=6, size=SIZE, ground_truth=False, colour_format="jpg")
    right = [frame.mask().ids for frame in open_scene(scene).frames]
    for path in (scene / "color").iterdir():
        tagged(path, orientation)
    stored = open_scene(scene)
    assert not any("EXIF" in warning for warning in stored.warnings)  # the masks fit as they are
    for path in (scene / "panoptic").iterdir():
        cv2.imwrite(str(path), np.rot90(cv2.imread(str(path)), turns))
    opened = open_scene(scene)
    assert any("are turned to the stored pictures" in warning for warning in opened.warnings)
    for frame, ids in zip(opened.frames, right, strict=True):
        np.testing.assert_array_equal(frame.mask().ids, ids)


ROOM = Lens().scaled(2.5)
BEND = of_opencv((-0.25, 0.06, 0.0, 0.0))


def as_ids(colour: np.ndarray) -> np.ndarray:
    return colour.astype(np.int32) @ np.array([1, 256, 65536], np.int32) + 1


def source(ids: list[np.ndarray]) -> MaskSource:
    def read(each: np.ndarray) -> FoundMask:
        return FoundMask(each, tuple(FoundSegment(int(n), int(n)) for n in np.unique(each) if n))

    sizes = [each.shape[::-1] for each in ids]
    return MaskSource({str(n): StoredMask(Path("m.png"), sizes[n], partial(read, each)) for n, each in enumerate(ids)})


@pytest.mark.parametrize("as_taken", [True, False])
def test_masks_of_distorted_photos_are_undistorted(as_taken: bool) -> None:
    taken = [look_bent(view, ROOM, BEND.bent).colour for view in views()]
    straight = [look(view, ROOM).colour for view in views()]
    scene_lens = Camera(ROOM.width, ROOM.height, ROOM.fx, ROOM.fy, ROOM.cx, ROOM.cy, np.eye(4))
    shown = {
        str(n): Pictured(
            lambda size, each=each: cv2.resize(undistorted(each, scene_lens, BEND, Path(), smooth=True), size),
            scene_lens.size, lens=(scene_lens, BEND),
        )
        for n, each in enumerate(taken)
    }  # fmt: skip
    found, told = placements(source([as_ids(each) for each in (taken if as_taken else straight)]), shown)
    assert [each.lens is not None for each in found.values()] == [as_taken] * 6 and bool(told) is as_taken
    for placement, mask, truth in zip(found.values(), taken, straight, strict=True):
        if as_taken:
            ids = placement(as_ids(mask))
            assert (ids == as_ids(truth))[ids > 0].mean() > 0.97


@pytest.mark.parametrize("height", [118, 104, 90])
@pytest.mark.parametrize("is_centred", [True, False])
def test_borders_that_a_network_padded_are_cut_off_masks(height: int, is_centred: bool) -> None:
    """A picture of 160 x ``height`` in a square of 320, or in the next multiple of 32; objects that touch its edges."""
    whole = np.zeros((height, 160), np.int32)
    whole[: height // 3, 20:70], whole[-height // 4 :, 90:150] = 1, 2
    shown = {str(n): Pictured(lambda size: np.zeros((*size[::-1], 3), np.uint8), (160, height)) for n in range(4)}
    large = cv2.resize(whole.astype(np.uint8), (320, 2 * height), interpolation=cv2.INTER_NEAREST).astype(np.int32)
    for side in (320, -(-2 * height // 32) * 32):
        over = side - 2 * height
        above = over // 2 if is_centred else 0
        boxed = np.pad(large, ((above, over - above), (0, 0)))
        found, told = placements(source([boxed] * 4), shown)
        np.testing.assert_array_equal(found["0"](boxed), large)
        assert "cut" in str(told)
    stretched = cv2.resize(whole.astype(np.uint8), (640, 480), interpolation=cv2.INTER_NEAREST).astype(np.int32)
    if height == 118:
        assert placements(source([stretched] * 4), shown)[0]["0"].box is None
    else:
        with raises_key("mask-shape|*"):
            placements(source([np.ones((320, 320), np.int32)] * 4), shown)


@pytest.mark.parametrize(("folder", "white"), [("keep", 255), ("masks", 255), ("masks", 1)])
def test_confidence_pictures_are_not_taken_for_class_masks(tmp_path: Path, folder: str, white: int) -> None:
    """As mask_path says, or by their values alone."""
    write_scene(tmp_path)
    table = tmp_path / "transforms.json"
    content = json.loads(table.read_text())
    kept = np.full((48, 64), white, np.uint8)
    kept[30:, 20:40] = 0
    for frame in content["frames"]:
        name = Path(frame["file_path"]).name
        write_grey(tmp_path / folder / f"{name}.png", kept)
        if (folder, white) != ("masks", 255):
            frame["mask_path"] = f"{folder}/{name}.png"
    table.write_text(json.dumps(content))
    scene = open_scene(tmp_path)
    assert not scene.has_masks and any("do not count" in warning for warning in scene.warnings)
    for frame in scene.frames:
        write_grey(tmp_path / "labels" / f"{frame.name}.png", np.full((48, 64), 2, np.uint8))
    scene = open_scene(tmp_path, masks=tmp_path / "labels", classes="nyu40:1-40")
    view = load_view(scene.frames[0])
    assert view.border is not None
    for marked in (view.border, view.mask.ids == 0, view.depth == 0):
        np.testing.assert_array_equal(marked, kept == 0)


def test_transforms_json_names_the_split_and_the_bad_frames(tmp_path: Path) -> None:
    write_scene(tmp_path)
    table = tmp_path / "transforms.json"
    content = json.loads(table.read_text())
    name = "./images/frame_{}.png".format

    def opened(**changed: object) -> tuple[list[str], list[str]]:
        table.write_text(json.dumps(content | changed))
        scene = open_scene(tmp_path)
        assert not any("splits.json" in each.reason for each in scene.inferred)
        return [f.name[6:] for f in scene.train_frames], [f.name[6:] for f in scene.test_frames]

    train = [name(n).removeprefix("./") for n in (8, 9, 12)]
    assert opened(train_filenames=train, test_filenames=[name(10)]) == (["8", "9", "12"], ["10"])
    assert any("split" in warning and "frame_11" in warning for warning in open_scene(tmp_path).warnings)
    assert opened(val_filenames=[name(9)]) == (["8", "10", "11", "12", "13"], ["9"])
    frames = {frame["file_path"]: frame for frame in content["frames"]}
    bad, test = frames.pop(name(12)) | {"is_bad": True}, frames.pop(name(9))
    assert opened(frames=[*frames.values(), bad], test_frames=[test]) == (["8", "10", "11", "13"], ["9"])
    assert any("is_bad" in warning and "frame_12" in warning for warning in open_scene(tmp_path).warnings)


@pytest.mark.parametrize(
    ("values", "is_metric"),
    [
        (lambda depth: depth, True),
        (lambda depth: np.where(np.arange(64) < 9, 0.0, depth), True),  # with holes
        (lambda depth: np.where(np.arange(64) < 9, np.nan, depth), True),
        (lambda depth: (depth - depth.min()) / np.ptp(depth), False),
        (lambda depth: 0.3 + 0.7 * (depth - depth.min()) / np.ptp(depth), False),
        (lambda depth: depth.min() / depth, False),
        (lambda depth: depth / 2, False),
    ],
)
def test_depth_of_a_tabletop_in_metres_is_not_taken_for_relative(
    tmp_path: Path, values: Callable[[np.ndarray], np.ndarray], is_metric: bool
) -> None:
    """A room shrunk to a fifth: all of its depths are below 1 m."""
    table = write_scene(tmp_path, depth=False) / "transforms.json"
    content = json.loads(table.read_text())
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] /= 5
    table.write_text(json.dumps(content))
    (tmp_path / "maps").mkdir()
    for i, view in enumerate(views()):
        shown = values(look(view, LENS).depth / 5).astype(np.float32)
        assert np.nanmax(shown) <= 1
        np.save(tmp_path / "maps" / f"frame_{i + 8}.npy", shown)
    if is_metric:
        assert any("agree between frames" in told for told in open_scene(tmp_path, depth=tmp_path / "maps").warnings)
        return
    with raises_key("depth-relative"):
        open_scene(tmp_path, depth=tmp_path / "maps")


@pytest.mark.parametrize("as_taken", [True, False])
@pytest.mark.parametrize(
    ("name", "first"),
    [("{}_raw_depth_meter.npy", 8), ("{}_pred.npy", 8), ("{}.npz", 8), ("{}_pred.npy", 9), ("{}.npy", 0)],
)
def test_depth_maps_are_paired_and_undistorted_to_fit(tmp_path: Path, as_taken: bool, name: str, first: int) -> None:
    """Maps of photos as taken, or of straightened ones, in several files and numbers."""
    write_scene(tmp_path, depth=False, k1=-0.25, k2=0.06)
    for i, view in enumerate(views()):
        write_colour(tmp_path / "images" / f"frame_{i + 8}.png", look_bent(view, LENS, BEND.bent).colour)
        depth = (look_bent(view, LENS, BEND.bent) if as_taken else look(view, LENS)).depth
        path = tmp_path / "maps" / name.format(f"frame_{i + first}")
        path.parent.mkdir(exist_ok=True)
        np.savez(path, depth=depth / 20, focal=1.0) if path.suffix == ".npz" else np.save(path, depth / 20)
        write_colour(tmp_path / "maps" / f"frame_{i + 8}.png", look(view, LENS).colour)  # to look at
    scene = open_scene(tmp_path)
    truth = {frame.name: look(view, LENS).depth for frame, view in zip(scene.frames, views(), strict=True)}
    places = [frame.camera.unproject(truth[frame.name])[4:-4:6, 4:-4:6].reshape(-1, 3) for frame in scene.frames]
    xyz = np.concatenate(places)
    seen, count = {}, len(xyz) // 6
    for n, frame in enumerate(scene.frames):
        seen[frame.name] = np.arange(n * count, (n + 1) * count)
    points = SparsePoints(xyz, np.zeros((len(xyz), 3), np.uint8), seen)
    lens = scene.frames[0].camera.at(np.eye(4))
    frames, _, told = with_estimated_depth(
        scene.frames,
        tmp_path / "maps",
        points,
        {frame.name: Pictured(frame.read_colour, frame.size, lens=(lens, BEND)) for frame in scene.frames},
    )
    assert len(told) == as_taken + (first != 8) and len(frames) == 6
    for frame in frames:
        depth = frame.depth()
        off = np.abs(depth - truth[frame.name])[depth > 0]
        assert (off < 0.05).mean() > 0.92 and len(off) > 0.9 * depth.size
    with raises_key("depth-relative" if first else "lacks-files"):
        open_scene(tmp_path, depth=tmp_path / "maps")
