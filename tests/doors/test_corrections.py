"""What docs/corrections.md promises, done as it says."""

import hashlib
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

import engine
from engine.passes.exr import read_exr
from tests.doors.terminal import Terminal
from tests.tiny_scene import CABINET_ID, CHAIR_ID, WALL_ID

# The tiny room's lift has a cabinet and a chair.
LIFT = "lifts/demo"
BAKE = ".venv/bin/python -m engine bake lifts/demo --frames test"
LIST = ".venv/bin/python -m engine correct lifts/demo list"
RENAME = """.venv/bin/python -m engine correct lifts/demo rename 6 "Anna's sofa\""""


def ids(terminal: Terminal) -> dict[str, int]:
    """The ids of the lift's objects by their class."""
    return {one.class_name: one.id for one in engine.read_lift(terminal.folder / LIFT).instances}


def held_out(terminal: Terminal) -> Path:
    """The passes of the held-out frame."""
    [passes] = (terminal.folder / LIFT / "result" / "passes").glob("*.exr")
    return passes


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*")) if path.is_file() and "passes" not in path.parts
    }  # fmt: skip


def test_what_you_mend_is_kept_in_corrections_json_and_result_stays(terminal: Terminal) -> None:
    before = digests(terminal.folder / LIFT / "result")
    terminal.run(RENAME, id6=ids(terminal)["chair"])
    assert digests(terminal.folder / LIFT / "result") == before
    kept = json.loads((terminal.folder / LIFT / "corrections.json").read_text())
    assert kept["edits"][0]["name"] == "Anna's sofa"
    assert "Anna's sofa" in terminal.run(LIST)
    said = terminal.run(RENAME.replace("Anna's sofa", "a, b"), id6=ids(terminal)["cabinet"])
    assert said.strip().endswith("to a, b; in Cryptomatte a b")


def test_frames_that_show_other_corrections_are_baked_again(terminal: Terminal) -> None:
    passes = held_out(terminal)
    terminal.run(BAKE)
    before = passes.read_bytes()
    terminal.run(RENAME, id6=ids(terminal)["chair"])
    terminal.run(BAKE)
    assert b"Anna s sofa" in passes.read_bytes() and b"Anna s sofa" not in before, "in its manifest, without the quote"


def test_with_a_class_of_stuff_the_object_becomes_points_of_it(terminal: Terminal) -> None:
    cabinet = ids(terminal)["cabinet"]
    terminal.run(".venv/bin/python -m engine correct lifts/demo reclass 16 cabinet", id16=cabinet, cabinet="wall")
    terminal.run(BAKE)
    shown = read_exr(held_out(terminal))
    assert cabinet not in shown.instance and CABINET_ID not in shown.semantic
    assert (shown.semantic == WALL_ID).any()


def test_merged_objects_become_the_first(terminal: Terminal) -> None:
    chair, cabinet = ids(terminal)["chair"], ids(terminal)["cabinet"]
    printed = ".venv/bin/python -m engine correct lifts/demo merge ONE OTHER ..."
    terminal.run(printed.removesuffix(" ..."), ONE=chair, OTHER=cabinet)
    lift = engine.read_lift(terminal.folder / LIFT)
    assert [one.id for one in lift.instances] == [chair]
    assert {*lift.points.class_id[lift.points.instance_id == chair]} == {CHAIR_ID}
    assert cabinet not in lift.points.instance_id


def test_the_points_of_a_deleted_object_become_what_surrounds_it(terminal: Terminal) -> None:
    chair = ids(terminal)["chair"]
    terminal.run(".venv/bin/python -m engine correct lifts/demo delete 22", id22=chair)
    lift = engine.read_lift(terminal.folder / LIFT)
    assert chair not in lift.points.instance_id and CHAIR_ID not in lift.points.class_id
    terminal.run(BAKE)
    shown = read_exr(held_out(terminal))
    assert chair not in shown.instance and (shown.semantic > 0).all()


def test_an_object_is_split_into_connected_parts(terminal: Terminal) -> None:
    """The tiny room's chair and cabinet are one object first, in two pieces."""
    chair, cabinet = ids(terminal)["chair"], ids(terminal)["cabinet"]
    terminal.run(".venv/bin/python -m engine correct lifts/demo merge ONE OTHER", ONE=chair, OTHER=cabinet)
    terminal.run(".venv/bin/python -m engine correct lifts/demo split 15 --parts", id15=chair)
    assert len(engine.read_lift(terminal.folder / LIFT).instances) >= 2


def test_an_object_is_split_by_a_plane(terminal: Terminal) -> None:
    cabinet = ids(terminal)["cabinet"]
    terminal.run(f".venv/bin/python -m engine correct lifts/demo split {cabinet} --plane 2.65 1.65 0.6 0 0 1")
    lift = engine.read_lift(terminal.folder / LIFT)
    tops = [lift.points.xyz[lift.points.instance_id == one.id, 2] for one in lift.instances if one.id != 0]
    cut = [z for z in tops if len(z)]
    assert len(cut) == 3 and sum(bool(z.min() > 0.59) for z in cut) == 1, "one part lies above the plane"


def test_an_object_is_split_into_what_two_frames_show_apart(terminal: Terminal) -> None:
    chair, cabinet = ids(terminal)["chair"], ids(terminal)["cabinet"]
    terminal.run(".venv/bin/python -m engine correct lifts/demo merge ONE OTHER", ONE=chair, OTHER=cabinet)
    terminal.run(".venv/bin/python -m engine correct lifts/demo split 15 --views", id15=chair)
    points = engine.read_lift(terminal.folder / LIFT).points
    centres = [points.xyz[points.instance_id == one].mean(axis=0) for one in np.unique(points.instance_id) if one]
    assert len(centres) == 2 and np.linalg.norm(centres[0] - centres[1]) > 0.8, "chair and cabinet again"


def test_accept_means_that_no_proposal_mentions_them_again(terminal: Terminal) -> None:
    propose = ".venv/bin/python -m engine correct LIFT propose"
    chair = ids(terminal)["chair"]
    terminal.run(".venv/bin/python -m engine correct lifts/demo accept 6", id6=chair)
    assert "chair 1" not in terminal.run(propose, LIFT=LIFT).replace("chair 1 is right", "")


def test_undo_takes_back_the_last_edit(terminal: Terminal) -> None:
    terminal.run(RENAME, id6=ids(terminal)["chair"])
    terminal.run(".venv/bin/python -m engine correct lifts/demo undo")
    assert "Anna's sofa" not in [one.name for one in engine.read_lift(terminal.folder / LIFT).instances]


def test_list_says_why_an_edit_of_a_missing_object_is_not_applied(terminal: Terminal) -> None:
    cabinet = ids(terminal)["cabinet"]
    terminal.run(RENAME, id6=cabinet)
    file = terminal.folder / LIFT / "corrections.json"
    kept = json.loads(file.read_text())
    kept["edits"][0]["objects"][0]["low"], kept["edits"][0]["objects"][0]["high"] = [90, 90, 90], [91, 91, 91]
    file.write_text(json.dumps(kept))
    assert "Anna's sofa" not in [one.name for one in engine.read_lift(terminal.folder / LIFT).instances]
    assert "NOT APPLIED" in terminal.run(LIST)
    assert json.loads(file.read_text()) == kept, "the edit stays in the file"


def test_several_programs_may_edit_one_lift_at_once_and_no_edit_is_lost(terminal: Terminal) -> None:
    both = ids(terminal)
    shell = [
        subprocess.Popen(
            f'.venv/bin/python -m engine correct {LIFT} rename {number} "my {name}"', shell=True, cwd=terminal.folder
        )
        for name, number in both.items()
    ]
    assert [each.wait() for each in shell] == [0] * len(both)
    assert {one.name for one in engine.read_lift(terminal.folder / LIFT).instances} == {f"my {name}" for name in both}


@pytest.mark.slow
def test_a_lift_with_names_from_takes_over_the_corrections(terminal: Terminal) -> None:
    terminal.run(RENAME, id6=ids(terminal)["chair"])
    quick = ["--steps", "5", "--set", "voxel_size=0.2", "--set", "warm_start=false"]
    terminal.run(f".venv/bin/python -m engine lift scans/room -o lifts/next --names-from {LIFT}", more=quick)
    assert "Anna's sofa" in [one.name for one in engine.read_lift(terminal.folder / "lifts/next").instances]
