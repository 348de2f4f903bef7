"""Opening a scene, and which file belongs to which frame, whatever its program added to the name."""

import json
import unicodedata
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.errors import Cancelled
from engine.job import EventWriter, StopSignal, progress
from engine.job.events import EventReader
from engine.scene import load_view, open_asked, open_scene
from engine.scene_source import SceneSource
from tests.scene.formats.room import write_grey
from tests.scene.formats.test_nerfstudio import write_scene
from tests.scene.mask_formats.labelled_room import Truth, check_on_room, write_masked_frames
from tests.scene.refusing import check_scene
from tests.scene.samples import OPTIONS, WRITERS, opened
from tests.tiny_scene import tiny_intrinsics, tiny_pose, trace_view, write_tiny_scene


def test_a_scene_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    scene = open_scene(write_tiny_scene(tmp_path, frames=6))
    assert [frame.name for frame in scene.frames] == [f"{i:04d}" for i in range(6)]
    assert [frame.name for frame in scene.test_frames] == ["0004"] and len(scene.train_frames) == 5
    assert scene.warnings == () and all(frame.read_ground_truth for frame in scene.frames)
    K = tiny_intrinsics((64, 48))
    for index, frame in enumerate(scene.frames):
        np.testing.assert_allclose(frame.camera.K, K, rtol=1e-12)
        np.testing.assert_allclose(frame.camera.camera_to_world, tiny_pose(index, 6), atol=1e-12)
        np.testing.assert_array_equal(frame.read_colour(None), trace_view(tiny_pose(index, 6), K, (64, 48)).colour)


def test_frames_whose_names_differ_only_in_capitals_are_reported(tmp_path: Path) -> None:
    """Their passes are files of these names, and many disks keep one of the two."""
    folder = write_tiny_scene(tmp_path, frames=5)
    for path in [*folder.glob("color/000[12].*"), *folder.glob("depth/000[12].*"), *folder.glob("pose/000[12].*")]:
        path.rename(path.with_stem("view_a" if "1" in path.stem else "View_A"))
    warnings = open_scene(folder).warnings
    assert sum("frames View_A, view_a have names that differ only in capitals" in told for told in warnings) == 1


def test_colour_depth_and_mask_of_a_view_have_one_size(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=5, depth_size=(32, 24), mask_size=(128, 96))
    frame = open_scene(folder).frames[0]
    assert frame.size == (64, 48) and frame.read_mask(None).ids.shape == (96, 128)
    for size in (None, (32, 24), (50, 40), (96, 72)):
        view = load_view(frame, size)
        width, height = size or (64, 48)
        assert view.colour.shape == (height, width, 3)
        assert view.depth.shape == view.mask.ids.shape == (height, width)
        assert (view.camera.width, view.camera.height) == (width, height)
    assert check_scene(open_scene(folder)) == ()


def test_only_frames_listed_in_the_split_need_files(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=6, splits={"train": ["0001", "0002"], "test": ["0005"]})
    (folder / "depth" / "0000.png").unlink()
    (folder / "panoptic" / "0003.png").unlink()
    scene = open_scene(folder)
    assert [frame.name for frame in scene.train_frames] == ["0001", "0002"]
    assert [frame.name for frame in scene.test_frames] == ["0005"]
    assert scene.warnings == ("3 frames are left out by splits.json: 0000, 0003, 0004",)
    check_scene(scene)


def test_one_intrinsic_matrix_is_scaled_to_frames_of_other_sizes(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=6)
    large = trace_view(tiny_pose(0, 6), tiny_intrinsics((128, 96)), (128, 96))
    cv2.imwrite(str(folder / "color" / "0000.png"), large.colour[..., ::-1])
    scene = open_scene(folder)
    assert scene.frames[0].size == (128, 96) and scene.frames[1].size == (64, 48)
    np.testing.assert_allclose(scene.frames[0].camera.K, tiny_intrinsics((128, 96)), rtol=1e-12)
    np.testing.assert_allclose(scene.frames[1].camera.K, tiny_intrinsics((64, 48)), rtol=1e-12)
    assert check_scene(scene) == ()


def test_a_frame_may_have_intrinsics_and_a_shape_of_its_own(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=6)
    size, K = (48, 64), tiny_intrinsics((48, 64))
    view = trace_view(tiny_pose(2, 6), K, size)
    cv2.imwrite(str(folder / "color" / "0002.png"), view.colour[..., ::-1])
    cv2.imwrite(str(folder / "depth" / "0002.png"), np.round(view.depth * 1000).astype(np.uint16))
    cv2.imwrite(str(folder / "panoptic" / "0002.png"), np.zeros((64, 48, 3), np.uint8))
    for kind in ("semantic", "instance"):
        (folder / "gt" / kind / "0002.png").unlink()
    K[:2, 2] -= 0.5
    np.savetxt(folder / "intrinsic" / "0002.txt", K)
    scene = open_scene(folder)
    np.testing.assert_allclose(scene.frames[2].camera.K, tiny_intrinsics(size), rtol=1e-9)
    assert scene.warnings == ("1 of 6 frames have no ground truth in semantic",)
    assert [warning.split(":")[0] for warning in check_scene(scene)] == [
        "1 frame has an empty mask",
        "4 segments of the masks' table have no pixel in the PNGs (the first",
    ]
    shared = folder / "intrinsic" / "intrinsic_color.txt"
    for index in {*range(6)} - {2}:
        (folder / "intrinsic" / f"{index:04d}.txt").write_bytes(shared.read_bytes())
    shared.unlink()
    np.testing.assert_allclose(open_scene(folder).frames[3].camera.K, tiny_intrinsics((64, 48)), rtol=1e-12)


def test_an_exif_orientation_tag_does_not_turn_the_picture(tmp_path: Path) -> None:
    folder = write_tiny_scene(tmp_path, frames=5, colour_format="jpg")
    path = folder / "color" / "0000.jpg"
    before = open_scene(folder).frames[0].read_colour(None)
    data = path.read_bytes()
    quarter_turn = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    path.write_bytes(data[:2] + b"\xff\xe1" + (2 + len(quarter_turn)).to_bytes(2, "big") + quarter_turn + data[2:])
    frame = open_scene(folder).frames[0]
    assert frame.size == (64, 48)
    np.testing.assert_array_equal(frame.read_colour(None), before)


@pytest.mark.parametrize("file", ["panoptic.json", "splits.json"])
def test_a_byte_order_mark_in_a_text_file_is_ignored(tmp_path: Path, file: str) -> None:
    names = [f"{i:04d}" for i in range(5)]
    folder = write_tiny_scene(tmp_path, frames=5, splits={"train": names[:4], "test": names[4:]})
    (folder / file).write_bytes(b"\xef\xbb\xbf" + json.dumps(json.loads((folder / file).read_text())).encode())
    assert len(open_scene(folder).frames) == 5


def report(folder: Path, name: str) -> tuple[object, ...]:
    scene = opened(folder, name)
    masks = [frame.mask().class_map().tolist() for frame in scene.frames if frame.read_mask is not None]
    return [(frame.name, frame.held_out) for frame in scene.frames], masks, scene.warnings


@pytest.mark.parametrize("name", WRITERS)
def test_hidden_files_of_macos_and_windows_are_ignored(name: str, tmp_path: Path) -> None:
    """Each file has a twin ._NAME of other bytes, and each folder has .DS_Store and Thumbs.db."""
    WRITERS[name](tmp_path)
    before = report(tmp_path, name)
    folders = [tmp_path, *(path for path in tmp_path.rglob("*") if path.is_dir())]
    for path in [path for path in tmp_path.rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"\x00\x05\x16\x07Mac OS X")
    for folder in folders:
        (folder / ".DS_Store").write_bytes(b"\x00\x00\x00\x01Bud1")
        (folder / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0")
    assert report(tmp_path, name) == before


@pytest.mark.parametrize("name", WRITERS)
def test_opening_a_scene_reports_progress_and_can_be_stopped(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "REPORT_EVERY_S", 0.0)
    WRITERS[name](tmp_path)
    source = SceneSource(tmp_path / "ai_001_001" if name == "hypersim" else tmp_path, **OPTIONS.get(name, {}))
    events, stop = EventWriter(tmp_path / "events.jsonl"), StopSignal()
    frames = len(open_asked(source, progress.StageProgress("check", events, stop)).frames)
    said = [(event.data["step"], event.data["steps"]) for event in EventReader(tmp_path / "events.jsonl").poll()]
    assert len(said) >= frames and all(steps >= frames for _, steps in said if name != "hypersim")  # a camera at a time
    shares = [step / steps for step, steps in said]
    assert shares == sorted(shares)
    told: list[int] = []

    def asks(done: int, total: int) -> None:
        told.append(done)
        stop.ask("enough")
        stop.check()

    with pytest.raises(Cancelled):
        open_asked(source, asks)
    assert told == [0]


def write_labels(folder: Path, rename: Callable[[str], str]) -> list[Truth]:
    masks, truths = write_masked_frames(folder)
    for truth in truths:
        write_grey(masks / "a.png", truth.semantic.astype(np.uint8))
        (masks / "a.png").rename(masks / rename(truth.name))
    return truths


@pytest.mark.parametrize(
    "name", ["{}.png", "{}.PNG", "{}.jpg.png", "{}_pred.png", "mask-{}.png", "room_{}_gtFine_labelIds.png"]
)
def test_a_suffix_common_to_all_mask_names_is_ignored(tmp_path: Path, name: str) -> None:
    truths = write_labels(tmp_path, name.format)
    (tmp_path / "masks" / "legend.png").write_bytes((tmp_path / "masks" / name.format("0000")).read_bytes())
    check_on_room(open_scene(tmp_path, classes="reduced", mask_format="palette"), truths, things=frozenset())


def test_decomposed_unicode_file_names_match_composed_ones(tmp_path: Path) -> None:
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
def test_masks_of_a_camera_rig_are_found_in_one_folder_per_camera(tmp_path: Path, cameras: tuple[str, str]) -> None:
    write_rig(tmp_path, cameras, labels_of)
    scene = open_scene(tmp_path, classes="nyu40:1-40")
    assert len(scene.frames) == 6
    for frame in scene.frames:
        _, camera, number = frame.name.split("_")
        label = 2 * int(number) + cameras.index(camera) + 1
        assert scene.classes[frame.mask().class_map()[-1, -1]].id == label


def test_transparent_pixels_have_no_colour_depth_or_class(tmp_path: Path) -> None:
    """Photos that a program cut out; an alpha channel that is opaque everywhere says nothing."""
    folder = write_tiny_scene(tmp_path / "scene", frames=4, size=(64, 48))
    for path in (folder / "color").iterdir():
        colour = cv2.imread(str(path))
        alpha = np.full(colour.shape[:2], 255, np.uint8)
        path.unlink()
        cv2.imwrite(str(path.with_suffix(".png")), np.dstack([colour, alpha]))
    assert all(frame.read_kept is None for frame in open_scene(folder).frames)
    for path in (folder / "color").iterdir():
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        pixels[:, :20, 3] = 0
        cv2.imwrite(str(path), pixels)
    scene = open_scene(folder)
    assert any("transparent" in each for each in scene.warnings)
    for frame in scene.frames:
        assert frame.read_kept is not None and not frame.read_kept((64, 48))[:, :20].any()
        assert frame.read_kept((64, 48))[:, 20:].all()
        assert not frame.depth((64, 48))[:, :20].any() and not frame.mask((64, 48)).ids[:, :20].any()
        assert frame.depth((64, 48))[:, 20:].any() and frame.mask((64, 48)).ids[:, 20:].any()
