"""request.json: what goes in comes out, and everything else is refused with a reason."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from engine.job import LiftFolder, LiftRequest
from tests.raises_key import raises_key

FULL = LiftRequest(
    scene=Path("/scenes/room"),
    masks=Path("/masks"),
    preset="paper",
    options={"steps": 9, "size": [64, 48], "frames": 0},
    fit=True,
    seed=3,
    up="-y",
    bake="all",
    scene_format="tum",
    depth=Path("/depth"),
    mask_format="sam2",
    classes="coco",
    device="cuda",
)


def test_a_lift_request_is_read_back_as_written(tmp_path: Path) -> None:
    for request in (FULL, LiftRequest(scene=Path("/scenes/Zimmer für zwei"))):
        (tmp_path / "request.json").write_text(request.to_json(), encoding="utf-8")
        assert LiftRequest.read(tmp_path / "request.json") == request


def test_request_json_has_the_documented_form() -> None:
    content = json.loads(LiftRequest(scene=Path("/s")).to_json())
    assert content == {
        "format": 1,
        "engine_version": content["engine_version"],
        "scene": "/s",
        "preset": "preview",
        "overrides": {},
        "up": "z",
        "device": "cpu",
    }


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"format": 2}, "other-format"),
        ({"format": None}, "other-format None"),
        ({"colour": 1}, "unknown-field"),
        ({"overrides": {"step": 3}}, "no-option step"),
        ({"overrides": [1]}, "bad-overrides"),
        ({"overrides": {"weights.dept": 0}}, "no-option weights.depth"),
        ({"overrides": {"objects": "two boxes"}}, "bad-value boxes"),
        ({"overrides": {"steps": "many"}}, "bad-value steps many"),
        ({"overrides": {"steps": 0}}, "bad-value steps"),
        ({"overrides": {"steps": True}}, "bad-value steps"),
        ({"overrides": {"rates.feature": [1, 1]}}, "no-option rates.feature"),
        ({"overrides": {"frames": -1}}, "bad-value frames -1"),
        ({"overrides": {"frames": "all"}}, "bad-value frames all"),
        ({"overrides": {"fit": 1}}, "wrong-type fit true false"),
        ({"overrides": {"size": [64]}}, "bad-value size"),
        ({"overrides": {"size": [64, 4.5]}}, "bad-value 4.5"),
        ({"overrides": {"size": "64x48x3"}}, "bad-value size 64x48x3"),
        ({"overrides": {"size": [8, 48]}}, "bad-value size"),
        ({"seed": -1}, "wrong-type seed 4294967295 -1"),
        ({"seed": 2**32}, "wrong-type seed"),
        ({"seed": None}, "wrong-type"),
        ({"scene": 5}, "wrong-type scene"),
        ({"scene": "relative"}, "relative scene"),
        ({"masks": 5}, "wrong-type masks"),
        ({"preset": "best"}, "wrong-type draft preview standard paper"),
        ({"preset": None}, "wrong-type preset"),
        ({"up": "x"}, "wrong-type -y"),
        ({"scene_format": 5}, "wrong-type scene_format"),
        ({"depth": 5}, "wrong-type"),
        ({"mask_format": 5}, "wrong-type mask_format"),
        ({"classes": ["coco"]}, "wrong-type classes"),
        ({"depth": "relative"}, "relative"),
        ({"bake": "some"}, "wrong-type test all none"),
        ({"device": "tpu"}, "wrong-type cpu cuda"),
        ({"device": 0}, "wrong-type device"),
        ({"engine_version": 1}, "wrong-type engine_version"),
    ],
)
def test_bad_values_in_request_json_are_refused(tmp_path: Path, change: dict[str, Any], told: str) -> None:
    path = tmp_path / "request.json"
    path.write_text(json.dumps(json.loads(FULL.to_json()) | change))
    with raises_key(f"{told} {path}") as caught:
        LiftRequest.read(path)
    assert caught.value.fix.endswith(".")


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"\xff\xfe{}", b"null", b"[" * 100_000, b" " * ((1 << 26) + 1)], ids=range(7)
)
def test_a_damaged_request_json_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "request.json"
    path.write_bytes(content)
    with raises_key("* request.json"):
        LiftRequest.read(path)


def test_the_differing_options_of_two_lift_requests_are_named() -> None:
    plain = LiftRequest(scene=FULL.scene, masks=FULL.masks, preset="paper", seed=3)
    reading = ["up", "scene_format", "depth", "mask_format", "classes"]
    assert FULL.differences(plain) == [*reading, "fit", "bake", "device", "steps", "size", "frames"]
    assert plain.differences(replace(plain, options={"weights.depth": 1.0})) == ["weights.depth"]
    assert plain.differences(replace(plain, options={"neighbours": 4})) == [], "that is the preset's"


@pytest.mark.skipif(os.name == "nt", reason="such names exist elsewhere only")
def test_paths_that_are_not_utf8_are_refused_in_a_lift_request(tmp_path: Path) -> None:
    broken = Path(os.fsdecode(b"/tmp/r\xf6om"))
    for asked in ({"scene": broken}, {"scene": tmp_path, "masks": broken}, {"scene": tmp_path, "depth": broken}):
        with raises_key("name-not-utf8 /tmp/r?om") as refused:
            LiftRequest(**asked)
        str(refused.value).encode()
    for refuse in (lambda path: LiftFolder.create(path, LiftRequest(scene=tmp_path)), LiftFolder.open):
        with raises_key("name-not-utf8"):
            refuse(tmp_path / broken.name)
    assert not (tmp_path / broken.name).exists()
