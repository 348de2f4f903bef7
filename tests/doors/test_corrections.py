"""What docs/corrections.md promises, done as it says."""

import hashlib
import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import engine
from engine.job import LiftFolder, LiftRequest, write_manifest
from engine.passes.exr import read_exr
from engine.result_files import (
    Instance,
    MatchedSegment,
    SemanticPoints,
    read_arrays,
    read_instances,
    write_arrays,
    write_instances,
)
from tests.corrections import two_rooms
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


def test_corrections_are_kept_in_corrections_json_and_result_is_unchanged(terminal: Terminal) -> None:
    before = digests(terminal.folder / LIFT / "result")
    terminal.run(RENAME, id6=ids(terminal)["chair"])
    assert digests(terminal.folder / LIFT / "result") == before
    kept = json.loads((terminal.folder / LIFT / "corrections.json").read_text())
    assert kept["edits"][0]["name"] == "Anna's sofa"
    assert "Anna's sofa" in terminal.run(LIST)
    said = terminal.run(RENAME.replace("Anna's sofa", "a, b"), id6=ids(terminal)["cabinet"])
    assert said.strip().endswith("to a, b; in Cryptomatte a b")
    terminal.run(RENAME.replace("Anna's sofa", "c, d"), id6=ids(terminal)["cabinet"])
    assert "to a, b\n" in terminal.run(LIST), "Cryptomatte has the later name"


def test_a_misspelt_object_or_class_is_answered_with_the_names_there_are(terminal: Terminal) -> None:
    for arguments, meant in (("rename chiar throne", "chair 1"), ("reclass cabinet-1 wall", "cabinet 1"),
                             ("reclass 'chair 1' cabinte", "cabinet"), ("remove chair", "chair 1")):  # fmt: skip
        told = terminal.run(f".venv/bin/python -m engine correct lifts/demo {arguments}", code=2)
        assert f"Did you mean {meant}? " in told and "corrections.json" not in told, told


def test_frames_that_show_other_corrections_are_baked_again(terminal: Terminal) -> None:
    passes = held_out(terminal)
    terminal.run(BAKE)
    before = passes.read_bytes()
    terminal.run(RENAME, id6=ids(terminal)["chair"])
    terminal.run(BAKE)
    assert b"Anna s sofa" in passes.read_bytes() and b"Anna s sofa" not in before, "in its manifest, without the quote"


def test_an_object_given_a_stuff_class_becomes_plain_points_of_that_class(terminal: Terminal) -> None:
    cabinet = ids(terminal)["cabinet"]
    said = terminal.run(
        ".venv/bin/python -m engine correct lifts/demo reclass 16 cabinet", id16=cabinet, cabinet="wall"
    )
    assert said.strip().endswith("to wall")
    terminal.run(BAKE)
    shown = read_exr(held_out(terminal))
    assert cabinet not in shown.instance and CABINET_ID not in shown.semantic
    assert (shown.semantic == WALL_ID).any()


def test_a_made_name_follows_its_class_wherever_it_is_shown(terminal: Terminal) -> None:
    chair = ids(terminal)["chair"]
    told = terminal.run(".venv/bin/python -m engine correct lifts/demo reclass 16 cabinet", id16=chair)
    assert told.strip().endswith(f"reclass {chair} to cabinet; now cabinet 2")
    assert "cabinet 2  (cabinet, " in terminal.run(LIST) and "chair 1" not in terminal.run(LIST)
    terminal.run(".venv/bin/python -m engine export lifts/demo --to gltf -o out --objects 'cabinet 2'")
    [file] = (terminal.folder / "out").glob("*.glb")
    assert b'"cabinet 2' in file.read_bytes() and b'"chair 1' not in file.read_bytes()


def test_merged_objects_get_the_id_of_the_first_one(terminal: Terminal) -> None:
    chair, cabinet = ids(terminal)["chair"], ids(terminal)["cabinet"]
    printed = ".venv/bin/python -m engine correct lifts/demo merge ONE OTHER ..."
    terminal.run(printed.removesuffix(" ..."), ONE=chair, OTHER=cabinet)
    lift = engine.read_lift(terminal.folder / LIFT)
    assert [one.id for one in lift.instances] == [chair]
    assert {*lift.points.class_id[lift.points.instance_id == chair]} == {CHAIR_ID}
    assert cabinet not in lift.points.instance_id


def test_points_of_a_deleted_object_take_the_class_around_them(terminal: Terminal) -> None:
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
    lift = engine.read_lift(terminal.folder / LIFT)
    assert {one.class_name for one in lift.instances} == {"chair", "cabinet"}, "each has the class of its own masks"
    assert all(one.name.startswith(one.class_name) for one in lift.instances), "and a name that says so"
    for part in (lift.points, lift.anchors, lift.gaussians):  # which follow the nearest point of the same label
        middles = [np.median(part.xyz[part.instance_id == one.id, 0]) for one in lift.instances]
        assert max(middles) - min(middles) > 0.5, type(part).__name__


def test_an_object_is_split_by_a_plane(terminal: Terminal) -> None:
    cabinet = ids(terminal)["cabinet"]
    terminal.run(f".venv/bin/python -m engine correct lifts/demo split {cabinet} --plane 2.65 1.65 0.6 0 0 1")
    lift = engine.read_lift(terminal.folder / LIFT)
    tops = [lift.points.xyz[lift.points.instance_id == one.id, 2] for one in lift.instances if one.id != 0]
    cut = [z for z in tops if len(z)]
    assert len(cut) == 3 and sum(bool(z.min() > 0.59) for z in cut) == 1, "one part lies above the plane"


def test_split_by_views_separates_objects_that_two_frames_show_apart(terminal: Terminal) -> None:
    chair, cabinet = ids(terminal)["chair"], ids(terminal)["cabinet"]
    terminal.run(".venv/bin/python -m engine correct lifts/demo merge ONE OTHER", ONE=chair, OTHER=cabinet)
    terminal.run(".venv/bin/python -m engine correct lifts/demo split 15 --views", id15=chair)
    points = engine.read_lift(terminal.folder / LIFT).points
    centres = [points.xyz[points.instance_id == one].mean(axis=0) for one in np.unique(points.instance_id) if one]
    assert len(centres) == 2 and np.linalg.norm(centres[0] - centres[1]) > 0.8, "chair and cabinet again"


def segments(*seen: tuple[int, int, int]) -> tuple[MatchedSegment, ...]:
    """Masks, each with its frame, its pixels and its class."""
    return tuple(MatchedSegment(str(at), 1, kind, 1, None, 1, pixels, 0.1, (0, 0, 1, 1)) for at, pixels, kind in seen)


TABLE, SIX = two_rooms.TABLE, tuple((frame, 100, two_rooms.TABLE) for frame in range(6))
DOUBTS: list[tuple[dict[str, Any], str]] = [
    ({"segments": segments(*SIX, (6, 9, two_rooms.CHAIR))}, "14 % of its masks say chair; reclass? (0)"),
    ({"segments": segments(*SIX, (1, 60, TABLE), (3, 90, TABLE))},
     "the masks of 2 of 6 frames separate it; split by views? (3)"),
    ({"segments": segments(*SIX, (1, 5, TABLE), (3, 90, TABLE))}, ""),  # a crumb, and a single frame
    ({"segments": segments(*SIX, *((at, 9, TABLE) for at in range(6, 12)), (1, 60, TABLE), (3, 90, TABLE))}, ""),
    ({"views": 1}, "only 1 frame shows it; delete? ()"),
]  # fmt: skip
"""Changes of the table of `two_rooms`, and what is then said of it."""


def test_propose_lists_doubtful_objects_the_worst_first_until_they_are_accepted(shell: Terminal) -> None:
    """A room made by hand: two chairs as one object, a table that most changes are about, and a crumb on it."""
    lift = LiftFolder.create(shell.folder / "lift", LiftRequest(scene=shell.folder))
    two_rooms.write_result(lift.path)
    write_manifest(lift.result_path, versions={}, seed=0, settings={}, timings={})
    classes, made = read_instances(lift.result_path / "instances.json")

    def proposed(**change: Any) -> list[str]:
        desk: list[Instance] = [replace(one, **change) if one.id == two_rooms.DESK else one for one in made]
        write_instances(lift.result_path / "instances.json", classes, desk)
        return shell.run(".venv/bin/python -m engine correct LIFT propose", LIFT="lift").splitlines()

    for change, told in DOUBTS:
        found = [line.strip() for line in proposed(**change)]
        assert [line for line in found if line.startswith("2 ")] == ([f"2  table 1: {told}"] if told else [])
        assert found[0] == "1  chair 1: it consists of 2 parts that do not touch; split? ()", "the worst comes first"
        assert "3  table 2: it touches table 1; merge? ()" in found
    points = read_arrays(lift.result_path / "semantic_points.npz", SemanticPoints)
    crumb = np.flatnonzero(points.instance_id == two_rooms.CRUMB)
    points.instance_id[crumb[20:]] = 0
    write_arrays(lift.result_path / "semantic_points.npz", points)
    assert any("table 2: it has only 20 points; delete?" in line for line in proposed())
    shell.run(".venv/bin/python -m engine correct lifts/demo accept 6".replace("lifts/demo", "lift"), id6=1)
    assert not any("chair 1" in line for line in proposed()) and proposed()[-1] == "1 of 3 corrected or accepted"


def test_undo_reverts_the_last_edit(terminal: Terminal) -> None:
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


def test_undone_edits_and_edits_of_newer_versions_stay_in_the_file(terminal: Terminal) -> None:
    terminal.run(RENAME, id6=ids(terminal)["chair"])
    terminal.run(".venv/bin/python -m engine correct lifts/demo undo")
    file = terminal.folder / LIFT / "corrections.json"
    kept = json.loads(file.read_text())
    kept["edits"].append({"uid": "a", "time": "2030", "kind": "paint", "brush": 3})
    file.write_text(json.dumps(kept))
    told = terminal.run(RENAME, id6=ids(terminal)["cabinet"])
    assert "warning: " in told and "does not know the edit 'paint'" in told
    undone, unknown, last = json.loads(file.read_text())["edits"]
    assert undone["undone"] and unknown["brush"] == 3 and last["name"] == "Anna's sofa"
    assert [one.name for one in engine.read_lift(terminal.folder / LIFT).instances] == ["Anna's sofa", "chair 1"]


def test_two_programs_that_edit_one_lift_at_once_lose_no_edit(terminal: Terminal) -> None:
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
def test_a_new_lift_with_names_from_keeps_the_corrections(terminal: Terminal) -> None:
    """Of fewer frames, by another preset."""
    chair, cabinet = ids(terminal)["chair"], ids(terminal)["cabinet"]
    terminal.run(RENAME, id6=chair)
    terminal.run(".venv/bin/python -m engine correct lifts/demo reclass 16 cabinet", id16=cabinet, cabinet="chair")
    file = terminal.folder / LIFT / "corrections.json"
    content = json.loads(file.read_text())
    content["edits"][1]["objects"][0] |= {"low": [90, 90, 90], "high": [91, 91, 91]}
    file.write_text(json.dumps(content))
    quick = ["--steps", "5", "--set", "voxel_size=0.2", "--set", "warm_start=false", "--frames", "3", "--bake", "test"]
    said = terminal.run(
        f".venv/bin/python -m engine lift scans/room -o lifts/next --names-from {LIFT} --preset standard", more=quick
    )
    assert "warning: reclass of " in said and "was not applied: " in said
    assert "1 correction of the earlier lift applies here" in said
    lift = engine.read_lift(terminal.folder / "lifts/next")
    assert {(one.name, one.class_name) for one in lift.instances} == {
        ("Anna's sofa", "chair"),
        ("cabinet 1", "cabinet"),
    }
    names = json.loads((terminal.folder / "lifts/next/result/names.json").read_text())
    assert {one["id"] for one in names["kept"]} == {chair, cabinet} and not names["new"] + names["gone"]
    assert b"Anna s sofa" in (terminal.folder / "lifts/next/result/passes/0004.exr").read_bytes()
    assert "0 views" in terminal.run(BAKE.replace("demo", "next")), "the lift's passes show corrections"


@pytest.mark.slow
def test_a_correction_gives_objects_of_preset_paper_one_class_each(terminal: Terminal) -> None:
    more = ["--preset", "paper", "--steps", "200", "--set", "voxel_size=0.1", "--bake", "test"]
    terminal.run(".venv/bin/python -m engine lift scans/room -o lifts/paper", more=more)
    passes = terminal.folder / "lifts/paper/result/passes/0004.exr"

    def pairs() -> set[tuple[int, int]]:
        shown = read_exr(passes)
        return {
            *zip(shown.instance[shown.instance > 0].tolist(), shown.semantic[shown.instance > 0].tolist(), strict=True)
        }

    before = pairs()
    chair = next(one.id for one in engine.read_lift(passes.parents[2]).instances if one.class_name == "chair")
    terminal.run(".venv/bin/python -m engine correct lifts/paper reclass 16 cabinet", id16=chair)
    terminal.run(BAKE.replace("demo", "paper"))
    assert len({number for number, _ in before}) < len(before), "pixels decide"
    assert {kind for _, kind in pairs()} == {CABINET_ID} and len(pairs()) == 2
