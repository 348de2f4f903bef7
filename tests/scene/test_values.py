"""Masks and ids whose values another program changed as it saved them again."""

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.scene import Scene, open_scene
from engine.scene.values import are_mixed, inside
from tests.raises_key import raises_key
from tests.scene.mask_formats.labelled_room import Truth, write_masked_frames
from tests.scene.mask_formats.test_tracks import palette_png
from tests.scene.refusing import refuses


def soft(mask: np.ndarray) -> np.ndarray:
    height, width = mask.shape
    small = cv2.resize(mask, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def as_jpeg(mask: np.ndarray) -> np.ndarray:
    return cv2.imdecode(cv2.imencode(".jpg", mask, [cv2.IMWRITE_JPEG_QUALITY, 75])[1], cv2.IMREAD_GRAYSCALE)


def disc(radius: int = 40, value: int = 255) -> np.ndarray:
    y, x = np.mgrid[:120, :160]
    return np.where((x - 80) ** 2 + (y - 60) ** 2 < radius**2, value, 0).astype(np.uint8)


@pytest.mark.parametrize(
    "values",
    [
        soft(disc()), as_jpeg(disc()), disc(value=1), disc(value=7), disc() > 0, disc() / 255,
        disc().astype(np.float32), (disc() / 255 - 0.5) * 8, disc().astype(np.uint16) * 257,
        (soft(disc()) / 255).astype(np.float16),
    ],
)  # fmt: skip
def test_soft_object_masks_are_cut_at_half_of_white(values: np.ndarray) -> None:
    assert (inside(values, Path()) == (disc() > 0)).mean() > 0.99
    assert not inside(np.zeros_like(values), Path()).any()


def test_a_picture_of_ids_is_not_taken_for_one_objects_mask() -> None:
    ids = disc(value=2)
    ids[:30] = 1
    ids[90:] = 3
    with raises_key("not-one-object 3"):
        inside(ids, Path())
    assert not inside(soft(disc(6, 90)), Path()).any()  # the edge of something that is hardly there


def test_mask_ids_blended_by_a_resize_are_refused(tmp_path: Path) -> None:
    masks, truths = write_masked_frames(tmp_path)
    for truth in truths:
        ids = cv2.resize(truth.semantic.astype(np.uint8), (256, 192), interpolation=cv2.INTER_NEAREST)
        assert not are_mixed(ids)
        cv2.imwrite(str(masks / f"{truth.name}.png"), soft(ids))
    with raises_key("mixed-ids 0000.png"):
        open_scene(tmp_path, mask_format="palette", classes="reduced").frames[0].mask()


def write_palettes(folder: Path, which: str) -> tuple[Path, list[Truth]]:
    """Each frame has a palette of its own, in which an object keeps its colour, as after another program's save."""
    masks, truths = write_masked_frames(folder)
    colours = np.array([[0, 0, 0], [20, 200, 90], [200, 40, 60], [9, 90, 230], [120, 120, 0]], np.uint8)
    for number, truth in enumerate(truths):
        of_ids = np.zeros(14, int)
        of_ids[[0, 1, 2, 3, 5, 13]] = [0, 1, 2, 3, 4, 0] if which == "semantic" else [0, 1, 2, 0, 0, 0]
        order = np.random.default_rng(number).permutation(5)
        indices = np.argsort(order)[of_ids[getattr(truth, which)]]
        whole = palette_png(indices)
        at = whole.index(b"PLTE") + 4
        data = whole[at - 4 : at] + colours[order].tobytes() + whole[at + 15 : at + 768]
        crc = zlib.crc32(data).to_bytes(4, "big")
        (masks / f"{truth.name}.png").write_bytes(whole[: at - 4] + data + crc + whole[at + 772 :])
    return folder, truths


def tracks_on(scene: Scene, truths: list[Truth]) -> dict[int, set[int | None]]:
    found: dict[int, set[int | None]] = {1: set(), 2: set()}
    for frame, truth in zip(scene.frames, truths, strict=True):
        mask = frame.mask()
        for one in mask.segments:
            found[int(np.median(truth.instance[mask.ids == one.id]))].add(one.track)
    return found


def test_an_object_keeps_its_id_where_palettes_differ(tmp_path: Path) -> None:
    scene, truths = write_palettes(tmp_path, "instance")
    opened = open_scene(scene, mask_format="sam2")
    assert any("by its colour" in warning for warning in opened.warnings)
    found = tracks_on(opened, truths)
    assert [len(each) for each in found.values()] == [1, 1] and found[1] != found[2]


def test_class_masks_whose_palettes_differ_are_refused(tmp_path: Path) -> None:
    scene, _ = write_palettes(tmp_path, "semantic")
    refuses("palettes-differ", scene, mask_format="palette", classes="nyu40")


def test_ids_repeated_in_three_equal_channels_are_read(tmp_path: Path) -> None:
    masks, truths = write_masked_frames(tmp_path)
    for truth in truths:
        cv2.imwrite(str(masks / f"{truth.name}.png"), np.stack([truth.semantic] * 3, -1))
    mask = open_scene(tmp_path, mask_format="palette", classes="reduced").frames[1].mask()
    np.testing.assert_array_equal(mask.class_map(), truths[1].semantic)


def test_soft_detection_masks_are_cut_at_half(tmp_path: Path) -> None:
    masks, truths = write_masked_frames(tmp_path)
    chairs = [cv2.resize((truth.instance == 1) * np.uint8(255), (256, 192), interpolation=0) for truth in truths]
    for truth, chair in zip(truths, chairs, strict=True):
        blurred = cv2.GaussianBlur(chair, (0, 0), 3)[None]
        np.savez(masks / f"{truth.name}.npz", masks=blurred, classes=np.array(["chair"]), scores=np.ones(1))
    for frame, chair in zip(open_scene(tmp_path).frames, chairs, strict=True):
        assert ((frame.mask().ids > 0) == (chair > 0)).mean() > 0.99
