"""Reading in parts takes and refuses what reading at once does, and never the whole file in one part."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from plgs.engine.errors import PlgsError
from plgs.engine.result_files import read_instances
from plgs.plgs_blender.results import reading_instances, result_of

ONE = {
    "id": 1, "name": "chair 1", "class_id": 1, "class_name": "chair", "colour": [1, 2, 3], "centre": [0, 0, 0.5],
    "size": [1, 1, 1], "yaw": 0.0, "rotation": [1, 0, 0, 0], "views": 1, "score": 0.5, "points": 7,
}  # fmt: skip
CLASSES = [{"id": 1, "name": "chair", "is_thing": True, "colour": [9, 9, 9]}]
WHOLE = {"format": 1, "up": "z", "classes": CLASSES, "instances": [ONE, ONE | {"id": 2, "name": "\ttürkis\u2028"}]}
MASK = {"frame": "0001", "segment_id": 3, "class_id": 1, "score": 0.5, "outline": ";".join(["0.100,0.200"] * 9)}
LONG = WHOLE | {"instances": [ONE | {"segments": [MASK] * 1500}]}
GOOD = [
    json.dumps(WHOLE), json.dumps(WHOLE, indent=1, ensure_ascii=False), "\ufeff" + json.dumps(WHOLE), json.dumps(LONG),
    json.dumps(WHOLE | {"instances": []}), json.dumps(dict(reversed(WHOLE.items()))),
    json.dumps(WHOLE).replace(",", " \n,\r\t").replace(":", " : "),
    json.dumps(WHOLE | {"classes": [CLASSES[0] | {"id": number} for number in range(1, 65_535)]}),
]  # fmt: skip
PLAIN = json.dumps(WHOLE)
BAD = [
    "", "[]", "7", "{", "}", "{}", PLAIN[:-1], PLAIN[:-2], PLAIN[:200], PLAIN + "}", PLAIN.replace(":", ";"),
    PLAIN.replace('"up": "z",', '"up"'), PLAIN.replace("}, {", "} {"), PLAIN.replace("}]}", "},]}"),
    PLAIN.replace("0.5", "NaN"), PLAIN.replace('"instances": [', '"instances": '),
    PLAIN.replace('"instances": [', '"instances": [7, '), '{"instances": ' + "[" * 5000,
    '{"instances": [' + "[" * 100_000,
]  # fmt: skip


@pytest.mark.parametrize("text", GOOD, ids=range(len(GOOD)))
def test_it_is_the_same(tmp_path: Path, text: str) -> None:
    path = tmp_path / "instances.json"
    path.write_text(text, encoding="utf-8")
    assert result_of(reading_instances(path)) == read_instances(path)


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_what_is_broken_is_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "instances.json"
    path.write_text(text, encoding="utf-8")
    for read in (read_instances, lambda path: result_of(reading_instances(path))):
        with pytest.raises(PlgsError) as error:
            read(path)
        assert "\n" not in str(error.value) and len(str(error.value)) < 2000


def test_another_version_is_named_whatever_its_objects_are(tmp_path: Path) -> None:
    path = tmp_path / "instances.json"
    path.write_text(json.dumps(WHOLE | {"format": 2, "instances": [{"id": "chair"}]}))
    for read in (read_instances, lambda path: result_of(reading_instances(path))):
        with pytest.raises(PlgsError, match="has format 2, but this version reads 1"):
            read(path)


def test_a_million_objects_are_refused_before_they_are_read(tmp_path: Path) -> None:
    path = tmp_path / "instances.json"
    several = json.dumps(ONE)[:-1] + ', "segments": []}'
    path.write_text(PLAIN[: PLAIN.index("[{", 100) + 1] + ",".join([several] * 200_000))
    with pytest.raises(PlgsError, match="more than 5000 objects"):
        result_of(reading_instances(path))
