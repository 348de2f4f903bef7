"""Cryptomatte, by its specification 1.2, and Blender's index passes."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from engine.errors import PlgsError
from engine.posed.exr_header import ExrHeader, read_exr_header
from engine.scene import open_scene
from engine.scene.exr_file import placed
from tests.scene.mask_formats.labelled_room import NAMES, Truth, check_on_room, mask_of, tracks, write_frames

OBJECTS = {1: "Wall.001", 2: "Floor", 3: "Cabinet.007", 5: "Chair.002", 13: "Ceiling"}
SHOWN = {1: "Wall", 2: "Floor", 3: "Cabinet", 5: "Chair", 13: "Ceiling"}
THINGS = frozenset({"Cabinet", "Chair"})
HASHES = {1: 0x3F1A22B3, 2: 0xC0D1E2F3, 3: 0x01234567, 5: 0x7E00BEEF, 13: 0xBF800001}
"""Any 32 bits that are no NaN, no infinity, and not 0 will do."""


def as_float(bits: int) -> float:
    return float(struct.unpack("<f", struct.pack("<I", bits))[0])


def write_exr(path: Path, channels: dict[str, np.ndarray], texts: dict[str, str]) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **texts}
    arrays = {name: np.ascontiguousarray(values, np.float32) for name, values in channels.items()}
    with OpenEXR.File(header, arrays) as file:
        file.write(str(path))


def matte(truth: Truth, layer: str, numbers: dict[int, str], values: dict[int, int]) -> tuple[dict, dict]:
    """Two ranks: what is seen covers 0.7 of a pixel, the wall behind it 0.3."""
    first = np.vectorize(lambda one: as_float(values[one]))(truth.semantic)
    second = np.full(truth.semantic.shape, as_float(values[1]))
    planes = (first, np.full(first.shape, 0.7), second, np.full(first.shape, 0.3))
    key = "cryptomatte/ab12cd3/"
    texts = {
        key + "name": layer,
        key + "hash": "MurmurHash3_32",
        key + "conversion": "uint32_to_float32",
        key + "manifest": json.dumps({numbers[one]: f"{values[one]:08x}" for one in numbers}),
    }
    return {f"{layer}00.{c}": plane for c, plane in zip("rgba", planes, strict=True)}, texts


def write_mattes(folder: Path) -> list[Truth]:
    scene, truths = write_frames(folder)
    (scene / "masks").mkdir()
    for truth in truths:
        channels, texts = matte(truth, "ViewLayer.CryptoObject", OBJECTS, HASHES)
        write_exr(scene / "masks" / f"{truth.name}.exr", channels | {"ViewLayer.Depth.V": truth.semantic}, texts)
    return truths


def test_names_are_classes_and_tracks(tmp_path: Path) -> None:
    truths = write_mattes(tmp_path)
    scene = open_scene(tmp_path)
    check_on_room(scene, truths, SHOWN, THINGS)
    assert tracks(scene, truths) == {1: {HASHES[5]}, 2: {HASHES[3]}}
    assert not scene.classes[[each.name for each in scene.classes.categories].index("Wall") + 1].is_thing


def test_what_nothing_covers_by_half_is_void(tmp_path: Path) -> None:
    truths = write_mattes(tmp_path)
    channels, texts = matte(truths[0], "ViewLayer.CryptoObject", OBJECTS, HASHES)
    channels["ViewLayer.CryptoObject00.g"][:4] = 0.4
    write_exr(tmp_path / "masks" / "0000.exr", channels, texts)
    mask = mask_of(open_scene(tmp_path))
    assert not mask.ids[:4].any() and mask.ids[4:].all()


def test_the_manifest_may_lie_beside(tmp_path: Path) -> None:
    truths = write_mattes(tmp_path)
    for truth in truths:
        channels, texts = matte(truth, "ViewLayer.CryptoObject", OBJECTS, HASHES)
        (tmp_path / "masks" / "names.json").write_text(texts.pop("cryptomatte/ab12cd3/manifest"))
        texts["cryptomatte/ab12cd3/manif_file"] = "names.json"
        write_exr(tmp_path / "masks" / f"{truth.name}.exr", channels, texts)
    check_on_room(open_scene(tmp_path), truths, SHOWN, THINGS)


def write_indices(folder: Path, with_materials: bool) -> list[Truth]:
    scene, truths = write_frames(folder)
    (scene / "masks").mkdir()
    for truth in truths:
        channels = {"ViewLayer.IndexOB.X": np.array([0, 40, 50])[truth.instance]}
        if with_materials:
            channels["ViewLayer.IndexMA.X"] = truth.semantic
        write_exr(scene / "masks" / f"{truth.name}.exr", channels, {})
    return truths


def test_object_indices_without_classes_have_one_class(tmp_path: Path) -> None:
    truths = write_indices(tmp_path, with_materials=False)
    scene = open_scene(tmp_path)
    check_on_room(scene, truths, {1: "", 2: "", 3: "object", 5: "object", 13: ""}, frozenset({"object"}))
    assert tracks(scene, truths) == {1: {40}, 2: {50}}


def test_material_indices_are_classes(tmp_path: Path) -> None:
    truths = write_indices(tmp_path, with_materials=True)
    scene = open_scene(tmp_path, classes="reduced")
    check_on_room(scene, truths, NAMES, frozenset({"chair"}))


def test_a_vast_part_behind_a_small_one_is_refused(tmp_path: Path) -> None:
    """The library reads all parts."""
    planes = {"Z": np.zeros((5, 4), np.float32)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    path = tmp_path / "a.exr"
    with OpenEXR.File([OpenEXR.Part({**header}, planes, "one"), OpenEXR.Part({**header}, planes, "two")]) as file:
        file.write(str(path))
    assert read_exr_header(path).numbers == 40
    window = b"dataWindow\0box2i\0" + struct.pack("<5i", 16, 0, 0, 3, 4)
    before, between, after = path.read_bytes().split(window)
    path.write_bytes(before + window + between + window[:-8] + struct.pack("<2i", 2**20, 2**20) + after)
    with pytest.raises(PlgsError, match="not the size of a picture"):
        read_exr_header(path)


def test_what_lies_outside_the_data_window_is_void() -> None:
    """A picture of 4x3 of which a renderer stored 4x4 pixels that begin one to the left and one above."""
    stored = np.arange(1.0, 17.0, dtype=np.float32).reshape(4, 4)
    whole = placed(stored, ExrHeader((4, 3), (-1, -1), ("A",), {}))
    assert whole.tolist() == [[6, 7, 8, 0], [10, 11, 12, 0], [14, 15, 16, 0]]
    assert not placed(stored, ExrHeader((4, 3), (9, 0), ("A",), {})).any()
