"""SAM 2's and Grounded-SAM-2's files: the same number in all frames is the same object."""

import json
import struct
import zlib
from pathlib import Path

import numpy as np

from engine.scene import list_classes, open_scene
from engine.scene_source import SceneSource
from tests.raises_key import raises_key
from tests.scene.mask_formats.labelled_room import Truth, check_on_room, tracks, write_frames, write_masked_frames
from tests.scene.refusing import refuses

OBJECTS = {1: "", 2: "", 3: "object", 5: "object", 13: ""}
TRACKS = {1: {7}, 2: {12}}
"""The chair is the room's object 1, SAM 2 calls it 7; the cabinet is 2, and 12 there."""
BOTH = frozenset({"object"})


def palette_png(indices: np.ndarray, bits: int = 8) -> bytes:
    """A PNG with colour type 3, by the PNG specification: each row has filter 0."""
    height, width = indices.shape
    shifts = np.arange(8 - bits, -1, -bits)
    padded = np.pad(indices, ((0, 0), (0, -width % len(shifts)))).astype(np.uint8)
    packed = (padded.reshape(height, -1, len(shifts)) << shifts).sum(-1).astype(np.uint8)
    rows = b"".join(b"\0" + row.tobytes() for row in packed)
    colours = bytes((37 * i + 11 * j) % 256 for i in range(2**bits) for j in range(3))
    header = struct.pack(">IIBBBBB", width, height, bits, 3, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"PLTE", colours), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )


def numbers_of(truth: Truth) -> np.ndarray:
    return np.array([0, 7, 12])[truth.instance]


def write_palettes(folder: Path) -> list[Truth]:
    masks, truths = write_masked_frames(folder)
    for truth in truths:
        (masks / f"{truth.name}.png").write_bytes(palette_png(numbers_of(truth), 4))
    return truths


def write_object_folders(folder: Path, chair: int = 0) -> list[Truth]:
    """A folder an object, all frames in each; where an object is not seen its PNG is black."""
    scene, truths = write_frames(folder)
    for truth in truths:
        for number, one in ((chair, 1), (12, 2)):
            (scene / "masks" / f"{number:03d}").mkdir(parents=True, exist_ok=True)
            seen = (truth.instance == one).astype(np.uint8)
            (scene / "masks" / f"{number:03d}" / f"{truth.name}.png").write_bytes(palette_png(seen))
    return truths


def write_pictures(folder: Path) -> list[Truth]:
    """SAM's amg.py: a folder a picture, a region a PNG, the chair's back inside the chair. Names are numbers."""
    scene, truths = write_frames(folder)
    for truth in truths:
        (scene / "masks" / truth.name).mkdir(parents=True)
        rows = ["id,area,bbox_x0,bbox_y0,bbox_w,bbox_h,predicted_iou"]
        for k, one in enumerate(n for n in (1, 2) if (truth.instance == n).any()):
            for number, region in ((2 * k, truth.instance >= one), (2 * k + 1, truth.instance == one)):
                (scene / "masks" / truth.name / f"{number}.png").write_bytes(palette_png(region.astype(np.uint8)))
                rows.append(f"{number},{region.sum()},0,0,9,9,{1.0 - 0.1 * number}")
        (scene / "masks" / truth.name / "metadata.csv").write_text("\n".join(rows))
    return truths


def write_grounded(folder: Path) -> list[Truth]:
    scene, truths = write_frames(folder)
    for kind in ("mask_data", "json_data"):
        (scene / "masks" / kind).mkdir(parents=True)
    for truth in truths:
        numbers = numbers_of(truth).astype(np.uint16)
        np.save(scene / "masks" / "mask_data" / f"mask_{truth.name}.npy", numbers)
        words = {7: "kitchen chair.", 12: "cabinet"}
        labels = {
            str(n): {"instance_id": n, "class_name": words[n], "x1": 3, "y1": 4, "x2": 9, "y2": 8, "logit": 0.0}
            for n in (7, 12) if (numbers == n).any()
        }  # fmt: skip
        content = {"mask_name": f"mask_{truth.name}.npy", "mask_height": 48, "mask_width": 64, "labels": labels}
        path = scene / "masks" / "json_data" / f"mask_{truth.name}.json"
        path.write_text(json.dumps(content | {"promote_type": "mask"}))
    return truths


def test_palette_pngs_that_may_be_classes_or_objects_need_a_choice(tmp_path: Path) -> None:
    write_palettes(tmp_path)
    refuses("several-formats sam2 palette --mask-format", tmp_path)


def test_folders_of_tracked_objects_may_have_any_names(tmp_path: Path) -> None:
    truths = write_object_folders(tmp_path)
    for old, new in (("000", "chair"), ("012", "a cabinet")):
        (tmp_path / "masks" / old).rename(tmp_path / "masks" / new)
    assert tracks(open_scene(tmp_path), truths) == {1: {2}, 2: {1}}


def test_numbered_folders_of_sams_amg_are_taken_for_frames(tmp_path: Path) -> None:
    """Their regions are no tracks and have no class, so that a table of classes changes nothing."""
    truths = write_pictures(tmp_path)
    for scene in (open_scene(tmp_path), open_scene(tmp_path, classes="coco")):
        check_on_room(scene, truths, OBJECTS, BOTH)
        assert tracks(scene, truths) == {1: {None}, 2: {None}}
    refuses("no-files png", tmp_path, mask_format="sam2")
    (tmp_path / "masks" / "0001" / "1.png").unlink()
    refuses("list-unmatched metadata.csv 1.png", tmp_path)
    (tmp_path / "masks" / "0001" / "metadata.csv").unlink()
    refuses("lacks-files PNGs metadata.csv 0001", tmp_path)


def test_a_class_table_gives_no_classes_to_numbered_objects(tmp_path: Path) -> None:
    """Of COCO's numbers, 7 is a truck."""
    truths = write_object_folders(tmp_path, 7)
    scene = open_scene(tmp_path, classes="coco")
    check_on_room(scene, truths, OBJECTS, BOTH)
    assert any("the table coco is left out" in one and "no classes" in one for one in scene.warnings)
    with raises_key("masks-classless classes.toml"):
        list_classes(SceneSource(tmp_path), "coco")
