"""The truth finds what was made wrong, and its edits bring the score back."""

import re
from pathlib import Path

import pytest

from engine.corrections import correct, making, read_corrected
from engine.errors import PlgsError
from engine.job import LiftRequest
from research.command_line import main
from research.correcting import before_and_after, correct_by_truth
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import TINY, lift_into, presets_as

Capture = pytest.CaptureFixture[str]


def test_errors_are_fixed_and_scored(tmp_path: Path, capsys: Capture) -> None:
    with presets_as(preview=TINY):
        lift = lift_into(tmp_path / "lift", LiftRequest(scene=write_tiny_scene(tmp_path / "room", frames=6))).path
    correct_by_truth(lift)
    right = read_corrected(lift)
    assert correct_by_truth(lift) == []  # nothing is left
    one = max(right.instances, key=lambda each: each.points)
    other = next(kind for kind in right.classes.categories if kind.is_thing and kind.id != one.class_id)
    _, best = before_and_after(lift)
    correct(lift, lambda state, _: making.reclass(state, [one.id], other.id))
    assert before_and_after(lift)[1] < best
    capsys.readouterr()
    assert main(["correct", str(lift)]) == 0
    said = capsys.readouterr().out
    assert f"{one.name} is {one.class_name}" in said and f"-> {100 * best:.1f} %" in said


def test_merged_objects_are_split_and_deleted_ones_painted(tmp_path: Path) -> None:
    with presets_as(preview=TINY):
        lift = lift_into(tmp_path / "lift", LiftRequest(scene=write_tiny_scene(tmp_path / "room", frames=6))).path
    correct_by_truth(lift)
    one, other = read_corrected(lift).instances[:2]
    _, best = before_and_after(lift)
    correct(lift, lambda state, _: making.merge(state, [one.id, other.id]))
    _, merged = before_and_after(lift)
    said = correct_by_truth(lift)
    _, after = before_and_after(lift)
    assert f"{one.name} is several things" in said and len(said) < 20
    assert merged < best and after > 0.9 * best


@pytest.mark.slow
def test_the_sample_is_better_after_fewer_than_20_edits(root: Path, tmp_path: Path, capsys: Capture) -> None:
    request = LiftRequest(scene=root / "sample" / "room", options={"steps": 200, "size": [160, 120]}, bake="none")
    lift = lift_into(tmp_path / "lift", request).path
    made = {path: path.read_bytes() for path in (lift / "result").rglob("*") if path.is_file()}
    capsys.readouterr()
    assert main(["correct", str(lift)]) == 0
    *said, last = capsys.readouterr().out.splitlines()
    before, after = map(float, re.fullmatch(r"PQ (\S+) % -> (\S+) %", last).groups())  # type: ignore[union-attr]
    assert 0 < len(said) < 20
    assert after > before + 1.0
    assert all(path.read_bytes() == content for path, content in made.items()), "result/ is as the engine made it"


def test_without_ground_truth_there_is_a_one_line_error(tmp_path: Path) -> None:
    with pytest.raises(PlgsError):
        correct_by_truth(tmp_path)
    assert main(["correct", str(tmp_path)]) == 2
