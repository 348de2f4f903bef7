"""Whatever is in a sample's files, opening and looking into it either works or raises PlgsError with one line."""

from __future__ import annotations

import json
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from engine.errors import PlgsError
from engine.scene import describe, open_scene
from tests.scene.formats import (
    test_colmap,
    test_hypersim,
    test_nerfstudio,
    test_open3d_log,
    test_polycam,
    test_posed_images,
    test_record3d,
    test_replica,
    test_scannetpp,
    test_sens,
    test_seven_scenes,
    test_stray,
    test_tum,
)
from tests.scene.formats.test_record3d import lzfse  # noqa: F401 - a fixture

ROUNDS = 6
ODD_WORDS = ("nan", "-inf", "1e999", "x", "", "-1", "0", "99999999999999999999", "../a", "\0")
ODD_VALUES = (None, True, -1, 1e308, 2**70, "x", "", [], {}, [1, 2], float("nan"))


def open3d(folder: Path) -> Path:
    test_open3d_log.write_images(folder, test_open3d_log.PRIMESENSE)
    (folder / "a.log").write_text(test_open3d_log.log(test_open3d_log.views()))
    (folder / "intrinsic.json").write_text(json.dumps(test_open3d_log.intrinsic(test_open3d_log.PRIMESENSE)))
    return folder


def sens(folder: Path) -> Path:
    (folder / "a.sens").write_bytes(test_sens.sens())
    return folder


WRITERS: dict[str, Callable[[Path], object]] = {
    "nerfstudio": test_nerfstudio.write_scene,
    "colmap": test_colmap.write_text,
    "colmap-binary": test_colmap.binary,
    "tum": test_tum.write_tum,
    "7scenes": test_seven_scenes.write_seven,
    "replica": test_replica.write_nice,
    "posed-images": test_posed_images.write_posed_images,
    "sens": sens,
    "polycam": test_polycam.write_polycam,
    "record3d": lambda folder: test_record3d.write_r3d(folder / "a.r3d"),
    "stray": test_stray.write_stray,
    "scannetpp": lambda folder: test_scannetpp.write_scannetpp(folder, test_scannetpp.lz4_blocks),
    "hypersim": lambda folder: test_hypersim.write_hypersim(folder / "ai_001_001", test_hypersim.USUAL),
    "open3d": open3d,
}


def cut(data: bytes, chance: random.Random) -> bytes:
    return data[: int(len(data) * chance.random())]


def damage(data: bytes, chance: random.Random) -> bytes:
    spoilt = bytearray(data)
    for _ in range(3):
        if spoilt:
            spoilt[chance.randrange(len(spoilt))] = chance.randrange(256)
    return bytes(spoilt)


def odd_word(data: bytes, chance: random.Random) -> bytes:
    """One number of a text is another."""
    found = [*re.finditer(rb"-?\d[\d.e+-]*", data)]
    if not found:
        return b""
    place = chance.choice(found)
    return data[: place.start()] + chance.choice(ODD_WORDS).encode() + data[place.end() :]


def odd_value(data: bytes, chance: random.Random) -> bytes:
    """One value of a JSON document is another; other files are emptied."""
    try:
        holder = content = json.loads(data)
    except ValueError:
        return b""
    while True:
        keys = [*holder] if isinstance(holder, dict) else [*range(len(holder))]
        key = chance.choice(keys)
        if not isinstance(holder[key], dict | list) or not holder[key] or chance.random() < 0.2:
            holder[key] = chance.choice(ODD_VALUES)
            return json.dumps(content).encode()
        holder = holder[key]


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_samples_get_a_line(tmp_path: Path, name: str) -> None:
    whole = tmp_path / "whole"
    whole.mkdir()
    WRITERS[name](whole)
    chance = random.Random(name)
    # One file of each kind at least: what a kind is, its suffix says.
    files = [path for path in sorted(whole.rglob("*")) if path.is_file()]
    kinds = {suffix: [path for path in files if path.suffix == suffix] for suffix in {path.suffix for path in files}}
    for turn in range(ROUNDS * len(kinds)):
        suffix = sorted(kinds)[turn % len(kinds)]
        spoil = (cut, damage, odd_word, odd_value)[chance.randrange(4 if suffix in (".json", "") else 3)]
        folder = tmp_path / "spoilt"
        shutil.copytree(whole, folder)
        path = folder / chance.choice(kinds[suffix]).relative_to(whole)
        path.write_bytes(spoil(path.read_bytes(), chance))
        place = folder / "ai_001_001" if name == "hypersim" else folder
        try:
            with np.errstate(all="ignore"):
                describe(open_scene(place))
        except PlgsError as error:
            assert "\n" not in str(error) and error.fix.endswith((".", "?")), str(error)
        except Exception as error:
            raise AssertionError(f"{spoil.__name__} of {path.relative_to(folder)} in turn {turn}") from error
        shutil.rmtree(folder)
