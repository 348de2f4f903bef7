"""A corrections.json of somebody else, of another lift, or vast."""

import json
from pathlib import Path

import pytest

from engine.corrections import CORRECTIONS, read_corrected
from engine.corrections.replay import Replay
from tests.test_fuzzing import read_corrections, write_corrections


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lifts")
    write_corrections(folder)
    return folder / "lift"


@pytest.fixture(scope="module")
def original(lift: Path) -> bytes:
    return (lift / CORRECTIONS).read_bytes()


def test_unprintable_text_of_an_unknown_edit_stays_out_of_its_warning(lift: Path, original: bytes) -> None:
    content = json.loads(original)
    content["edits"][1]["kind"], content["edits"][2]["time"] = "\ud7fc", "\u202e"
    (lift / CORRECTIONS).write_text(json.dumps(content))
    read_corrections(lift.parent)


def test_six_hundred_edits_that_fit_no_object_compare_points_only_a_few_times(
    lift: Path, original: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = json.loads(original)
    first = content["edits"][0]
    mark = first["objects"][0]
    of_another = {**mark, "low": [90.0, 90.0, 0.0], "high": [91.0, 91.0, 1.0]}
    renames = [{**first, "uid": f"{n:032x}", "objects": [of_another]} for n in range(300)]
    merges = [{**first, "uid": f"{n:032x}", "kind": "merge", "objects": [mark, mark]} for n in range(300, 600)]
    for edit in merges:
        edit.pop("name", None)
    (lift / CORRECTIONS).write_text(json.dumps({**content, "edits": renames + merges}))
    looks = []
    look = Replay.mark
    monkeypatch.setattr(Replay, "mark", lambda self, number: (looks.append(number), look(self, number))[1])
    assert len(read_corrected(lift).warnings) == 600 and len(looks) < 5


@pytest.mark.parametrize(
    ("number", "changed", "told"),
    [
        (0, {"objects": []}, "it names no object"),
        (3, {"objects": []}, "it names no object"),
        (2, {"made": [{"id": 9, "name": "a", "class_id": 0}]}, "there is no class 0"),
        (2, {"moved": [{"label": -99, "millimetres": [0, 0, 0]}]}, "there is no class 99"),
        (2, {"rest": 77}, "there is no object 77"),
    ],
)
def test_impossible_edits_warn(lift: Path, original: bytes, number: int, changed: dict[str, object], told: str) -> None:
    content = json.loads(original)
    content["edits"][number].update(changed)
    (lift / CORRECTIONS).write_text(json.dumps(content))
    assert any(line.endswith(told) for line in read_corrected(lift).warnings)
