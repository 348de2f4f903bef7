"""Whatever is in a scene's files, opening and checking it either works or raises PlgsError with one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.errors import PlgsError
from engine.scene import check_scene, open_scene
from tests.fuzzing import examples
from tests.tiny_scene import write_tiny_scene

odd_values = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=8),
    st.just([]),
    st.just({}),
    st.lists(st.integers(-1, 300), max_size=3),
    st.sampled_from(["0001.png", "../0001.png", "\0", 1e308, 2**31, 2**63, -1, 0]),
)
quick = examples(60)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    names = [f"{i:04d}" for i in range(3)]
    folder = tmp_path_factory.mktemp("scene")
    return write_tiny_scene(folder, frames=3, size=(16, 12), splits={"train": names[:2], "test": names[2:]})


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The way to every value inside a JSON document."""
    found = [path]
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        found += places(item, (*path, key))
    return found


def survives(folder: Path) -> None:
    try:
        check_scene(open_scene(folder))
    except PlgsError as error:
        assert "\n" not in str(error) and error.fix


@quick
@given(data=st.data(), file=st.sampled_from(["panoptic.json", "splits.json"]))
def test_odd_values_in_json(scene: Path, data: st.DataObject, file: str) -> None:
    original = (scene / file).read_text()
    content = json.loads(original)
    *way, last = data.draw(st.sampled_from(places(content)[1:]))
    holder = content
    for key in way:
        holder = holder[key]
    if data.draw(st.booleans()):
        holder[last] = data.draw(odd_values)
    else:
        del holder[last]
    try:
        (scene / file).write_text(json.dumps(content))
        survives(scene)
    finally:
        (scene / file).write_text(original)


@quick
@given(
    file=st.sampled_from(
        [
            "panoptic.json",
            "splits.json",
            "pose/0001.txt",
            "intrinsic/intrinsic_color.txt",
            "color/0001.png",
            "depth/0001.png",
            "panoptic/0001.png",
            "gt/semantic/0001.png",
        ]
    ),
    start=st.integers(0, 2000),
    length=st.integers(0, 40),
    noise=st.binary(max_size=20),
)
def test_damaged_bytes_anywhere(scene: Path, file: str, start: int, length: int, noise: bytes) -> None:
    original = (scene / file).read_bytes()
    start %= len(original)
    try:
        (scene / file).write_bytes(original[:start] + noise + original[start + length :])
        survives(scene)
    finally:
        (scene / file).write_bytes(original)
