"""Cryptomatte, by its specification 1.2, and Blender's index passes."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from engine.errors import PlgsError
from engine.posed.exr_header import read_exr_header
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


def write_exr(path: Path, channels: dict[str, np.ndarray], texts: dict[str, object], dtype: type = np.float32) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **texts}
    with OpenEXR.File(header, arrays_of(channels, dtype)) as file:
        file.write(str(path))


def arrays_of(channels: dict[str, np.ndarray], dtype: type = np.float32) -> dict[str, np.ndarray]:
    with np.errstate(over="ignore", invalid="ignore"):
        return {name: np.ascontiguousarray(values, dtype) for name, values in channels.items()}


def write_parts(path: Path, parts: dict[str, tuple[dict[str, np.ndarray], dict[str, str]]]) -> None:
    """A part for each name, with its channels and texts."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    made = [OpenEXR.Part({**header, **texts}, arrays_of(planes), name) for name, (planes, texts) in parts.items()]
    with OpenEXR.File(made) as file:
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


def renamed(channels: dict[str, np.ndarray], start: str) -> dict[str, np.ndarray]:
    return {start + name.rpartition(".")[2].upper(): plane for name, plane in channels.items()}


@pytest.mark.parametrize("layout", ["blender 5.2", "bare channels", "one number for two layers", "short names"])
def test_parts_are_read_as_one_picture(tmp_path: Path, layout: str) -> None:
    truths = write_mattes(tmp_path)
    for truth in truths:
        path, black = tmp_path / "masks" / f"{truth.name}.exr", {"R": np.zeros(truth.semantic.shape)}
        channels, texts = matte(truth, "ViewLayer.CryptoObject", OBJECTS, HASHES)
        others, other_texts = matte(truth, "ViewLayer.CryptoMaterial", OBJECTS, {**HASHES, 5: HASHES[3]})
        bare = {"ViewLayer.CryptoObject00": (renamed(channels, ""), texts)}
        if layout == "blender 5.2":
            index = {"ViewLayer.Object Index.X": truth.instance}
            write_parts(path, {
                "ViewLayer.Combined": (renamed(black, "ViewLayer.Combined."), texts),
                "ViewLayer.Object Index": (index, {}),
                "ViewLayer.CryptoObject00": (channels, {}),
            })  # fmt: skip
        elif layout == "bare channels":
            write_parts(path, {"rgb": (black, {}), "ViewLayer.CryptoObject": (black, {}), **bare})
        elif layout == "one number for two layers":
            write_parts(path, {"ViewLayer.CryptoMaterial00": (renamed(others, ""), other_texts), **bare})
        else:
            write_exr(path, renamed(channels, "CryptoObject00."), texts)
    scene = open_scene(tmp_path)
    check_on_room(scene, truths, SHOWN, THINGS)
    assert tracks(scene, truths) == {1: {HASHES[5]}, 2: {HASHES[3]}}


def test_a_damaged_part_is_refused(tmp_path: Path) -> None:
    """The library leaves it out, and the next one would stand in its place."""
    truths = write_mattes(tmp_path)
    channels, texts = matte(truths[0], "CryptoObject", OBJECTS, HASHES)
    path, bare = tmp_path / "masks" / "0000.exr", renamed(channels, "")
    write_parts(
        path, {"other": ({"V": truths[0].semantic}, {}), "CryptoObject00": (bare, texts), "CryptoObject01": (bare, {})}
    )
    data = path.read_bytes()
    chunk = re.search(rb"(?s)\0{8}.{4}\x78[\x01\x5e\x9c\xda]", data)
    assert chunk is not None
    path.write_bytes(data[: chunk.end()] + b"\xff" * 4 + data[chunk.end() + 4 :])
    with pytest.raises(PlgsError, match="cannot be read, or is cut off"):
        mask_of(open_scene(tmp_path))


@pytest.mark.parametrize(
    ("dtype", "name", "compression", "what"),
    [
        (np.float16, "r", "ZIP", "32-bit floats: 32 bits are needed"),
        (np.uint32, "r", "ZIP", "32-bit floats: 32 bits are needed"),
        (np.float32, "r", "PXR24", "loss of bits: 32 bits are needed"),
        (np.float32, "R", "DWAA", "loss of bits: 32 bits are needed"),
    ],
)
def test_names_that_lost_bits_are_refused(tmp_path: Path, dtype: type, name: str, compression: str, what: str) -> None:
    truths = write_mattes(tmp_path)
    channels, texts = matte(truths[0], "ViewLayer.CryptoObject", OBJECTS, HASHES)
    planes = {f"ViewLayer.CryptoObject00.{name}": channels["ViewLayer.CryptoObject00.r"], **channels}
    if name == "R":
        planes = renamed(channels, "ViewLayer.CryptoObject00.")
    lossy = {**texts, "compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    write_exr(tmp_path / "masks" / "0000.exr", planes, lossy, dtype)
    with pytest.raises(PlgsError, match=rf"{what}.*0000\.exr"):
        open_scene(tmp_path)


@pytest.mark.parametrize(
    ("names", "taken"),
    [
        (["a.crypto_material", "b.crypto_asset"], "b.crypto_asset"),
        (["a.crypto_asset", "b.crypto_object"], "b.crypto_object"),
        (["VRayCryptomatte_mtl", "VRayCryptomatte"], "VRayCryptomatte"),
        (["ObjectRoom.CryptoMaterial", "Room.CryptoObject"], "Room.CryptoObject"),
        (["Classroom.CryptoObject", "Classroom.CryptoMaterial"], "Classroom.CryptoObject"),
        (["CryptoMaterial"], "CryptoMaterial"),
    ],
)
def test_objects_come_before_materials(tmp_path: Path, names: list[str], taken: str) -> None:
    truths = write_mattes(tmp_path)
    for turned in (False, True):
        for truth in truths:
            channels, texts = dict[str, np.ndarray](), dict[str, str]()
            for number, name in enumerate(names):
                words = {one: word if name == taken else "Wrong" for one, word in OBJECTS.items()}
                planes, found = matte(truth, name, words, HASHES)
                channels |= planes
                order = -number if turned else number
                texts |= {key.replace("ab12cd3", f"{5 + order}"): text for key, text in found.items()}
            write_exr(tmp_path / "masks" / f"{truth.name}.exr", channels, texts)
        scene = open_scene(tmp_path)
        check_on_room(scene, truths, SHOWN, THINGS)
        assert sum(f'"{taken}"' in warning for warning in scene.warnings) == 1


def test_frames_with_objects_and_frames_with_materials_alone_are_refused(tmp_path: Path) -> None:
    truths = write_mattes(tmp_path)
    write_exr(tmp_path / "masks" / "0001.exr", *matte(truths[1], "ViewLayer.CryptoMaterial", OBJECTS, HASHES))
    with pytest.raises(PlgsError, match=r"lacks the Cryptomatte of objects.*0001\.exr"):
        open_scene(tmp_path)


def write_indices(folder: Path, with_materials: bool, names: tuple[str, str] = ("IndexOB", "IndexMA")) -> list[Truth]:
    scene, truths = write_frames(folder)
    (scene / "masks").mkdir()
    for truth in truths:
        channels = {f"ViewLayer.{names[0]}.X": np.array([0, 40, 50])[truth.instance]}
        if with_materials:
            channels[f"ViewLayer.{names[1]}.X"] = truth.semantic
        write_exr(scene / "masks" / f"{truth.name}.exr", channels, {})
    return truths


def test_object_indices_without_classes_have_one_class(tmp_path: Path) -> None:
    truths = write_indices(tmp_path, with_materials=False)
    scene = open_scene(tmp_path)
    check_on_room(scene, truths, {1: "", 2: "", 3: "object", 5: "object", 13: ""}, frozenset({"object"}))
    assert tracks(scene, truths) == {1: {40}, 2: {50}}


@pytest.mark.parametrize("names", [("IndexOB", "IndexMA"), ("Object Index", "Material Index")])
@pytest.mark.parametrize("in_parts", [False, True])
def test_material_indices_are_classes(tmp_path: Path, names: tuple[str, str], in_parts: bool) -> None:
    truths = write_indices(tmp_path, with_materials=True, names=names)
    for truth in truths if in_parts else []:
        parts = {names[0]: ({"X": np.array([0, 40, 50])[truth.instance]}, {}), names[1]: ({"X": truth.semantic}, {})}
        write_parts(tmp_path / "masks" / f"{truth.name}.exr", parts)
    scene = open_scene(tmp_path, classes="reduced")
    check_on_room(scene, truths, NAMES, frozenset({"chair"}))


def test_what_is_chosen_of_index_passes_is_told(tmp_path: Path) -> None:
    truths = write_indices(tmp_path, with_materials=True)
    wrong = np.full(truths[0].semantic.shape, 7)
    channels = {f"ViewLayer.{one}.X": wrong for one in ("IndexOB", "IndexMA")}
    channels |= {"First.IndexOB.X": np.array([0, 40, 50])[truths[0].instance], "First.IndexMA.X": truths[0].semantic}
    write_exr(tmp_path / "masks" / "0000.exr", channels, {})
    scene = open_scene(tmp_path, classes="reduced")
    check_on_room(scene, truths, NAMES, frozenset({"chair"}))
    assert 'the objects are those of "First.IndexOB.X", not of "ViewLayer.IndexOB.X"' in scene.warnings
    write_exr(tmp_path / "masks" / "0000.exr", {"IndexOB.X": np.array([0, 40, 50])[truths[0].instance]}, {})
    scene = open_scene(tmp_path)
    assert any("no mask has classes: 0000" in warning for warning in scene.warnings)


def test_index_passes_that_lost_bits_are_refused(tmp_path: Path) -> None:
    truths = write_indices(tmp_path, with_materials=False)
    objects = np.array([0, 40, 50])[truths[0].instance]
    write_exr(tmp_path / "masks" / "0000.exr", {"IndexOB.X": objects}, {}, np.float16)
    assert {one.track for one in mask_of(open_scene(tmp_path)).segments} == {40, 50}
    write_exr(tmp_path / "masks" / "0000.exr", {"IndexOB.X": objects + 2049}, {}, np.float16)
    with pytest.raises(PlgsError, match="were rounded"):
        mask_of(open_scene(tmp_path))


def test_cryptomatte_comes_before_the_object_index(tmp_path: Path) -> None:
    truths = write_mattes(tmp_path)
    for truth in truths:
        channels, texts = matte(truth, "ViewLayer.CryptoObject", OBJECTS, HASHES)
        index = {"ViewLayer.IndexOB.X": np.array([0, 40, 50])[truth.instance]}
        write_exr(tmp_path / "masks" / f"{truth.name}.exr", channels | index, texts)
    scene = open_scene(tmp_path)
    check_on_room(scene, truths, SHOWN, THINGS)
    assert any("--mask-format object-index" in warning for warning in scene.warnings)
    assert tracks(open_scene(tmp_path, mask_format="object-index"), truths) == {1: {40}, 2: {50}}


def test_of_several_views_the_first_is_read_and_told(tmp_path: Path) -> None:
    truths = write_mattes(tmp_path)
    channels, texts = matte(truths[0], "ViewLayer.CryptoObject", OBJECTS, HASHES)
    wrong = {name: np.zeros_like(plane) for name, plane in channels.items()}
    parts = {"a": (channels, {**texts, "view": "left"}), "b": (wrong, {**texts, "view": "right"})}
    write_parts(tmp_path / "masks" / "0000.exr", parts)
    scene = open_scene(tmp_path)
    check_on_room(scene, truths, SHOWN, THINGS)
    assert 'of the views of the masks, "left" is read, not "right"' in scene.warnings


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
    whole = placed(stored, (4, 3), (-1, -1))
    assert whole.tolist() == [[6, 7, 8, 0], [10, 11, 12, 0], [14, 15, 16, 0]]
    assert not placed(stored, (4, 3), (9, 0)).any()
