"""Edits of a result: what they change, what survives, and what is told."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.corrections import (
    CORRECTIONS,
    CorrectedResult,
    class_of_parts,
    correct,
    editing,
    proposals_of,
    read_corrected,
    replayed,
    undo,
)
from engine.corrections import making as m
from engine.corrections.making import class_of
from engine.corrections.relabelling import nearest
from engine.corrections.replay import Replay
from engine.posed.classes import Category, ClassTable
from engine.result_files import Instance, MatchedSegment
from tests.corrections.two_rooms import CHAIR, CHAIRS, CRUMB, DESK, TABLE, write_result
from tests.raises_key import raises_key


@pytest.fixture
def lift(tmp_path: Path) -> Path:
    return write_result(tmp_path / "lift")


def split_chairs(state: Replay, first_id: int) -> object:
    return m.split(state, CHAIRS, m.parts_of(state.points_of(CHAIRS)), first_id)


def merge(*ids: int) -> object:
    return lambda state, first_id: m.merge(state, ids)


def objects(lift: Path) -> dict[int, Instance]:
    return {one.id: one for one in read_corrected(lift).instances}


def counts(result: CorrectedResult) -> dict[tuple[int, int], int]:
    pairs = zip(result.points.class_id.tolist(), result.points.instance_id.tolist(), strict=True)
    found: dict[tuple[int, int], int] = {}
    for pair in pairs:
        found[pair] = found.get(pair, 0) + 1
    return found


def test_a_lift_without_corrections_is_read_as_it_was_made(lift: Path) -> None:
    result = read_corrected(lift)
    assert result.instances == result.made and not result.changes_labels and result.fingerprint == ""
    with editing(lift):
        pass
    assert not (lift / CORRECTIONS).exists()


def test_three_hundred_edits_look_up_each_objects_points_only_once(lift: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[int] = []
    points_of = Replay.points_of
    monkeypatch.setattr(Replay, "points_of", lambda state, number: looks.append(number) or points_of(state, number))
    with editing(lift) as edits:
        state = Replay.of(*(getattr(read_corrected(lift), name) for name in ("classes", "made", "points")))
        edits += [m.rename(state, DESK if each % 2 else CHAIRS, f"name {each}") for each in range(300)]
        state.apply_all(edits)
    looks.clear()
    assert objects(lift)[DESK].name == "name 299" and sorted(looks) == [CHAIRS, DESK]


def test_two_chairs_in_one_box_are_separated(lift: Path) -> None:
    edit, _ = correct(lift, split_chairs)
    found = objects(lift)
    assert edit.made[0].id == 4 and found[4].name == "chair 2" and found[4].points == found[CHAIRS].points
    assert sorted(round(found[one].centre[0], 2) for one in (CHAIRS, 4)) == [0.2, 1.2]
    assert all(abs(found[one].size[0] - 0.4) < 0.03 for one in (CHAIRS, 4))
    result = read_corrected(lift)
    anchors = result.anchors()
    for one in (CHAIRS, 4):  # an anchor follows the nearest point
        assert np.ptp(anchors.xyz[anchors.instance_id == one], axis=0)[0] < 0.5
    assert found[DESK] == result.made[1]  # an untouched box never moves


def test_a_made_name_follows_the_class_and_a_persons_stays(lift: Path) -> None:
    """A number is never given twice: scripts call objects by their names."""
    correct(lift, split_chairs)  # chair 1 and chair 2
    correct(lift, lambda state, _: m.rename(state, CHAIRS, "chair 9"))
    correct(lift, lambda state, _: m.reclass(state, [CHAIRS, 4, CRUMB], "table"))
    found = objects(lift)
    assert (found[DESK].name, found[CRUMB].name, found[4].name) == ("table 1", "table 2", "table 3")
    assert found[CHAIRS].name == "chair 9" and found[CHAIRS].class_name == "table"
    with raises_key("no-object") as raised:
        m.object_of(replayed(lift), "chair 2")
    assert "It is called table 3 now." in str(raised.value)
    correct(lift, lambda state, _: m.reclass(state, [4], "chair"))
    assert objects(lift)[4].name == "chair 10"
    undo(lift)
    assert objects(lift)[4].name == "table 3"
    undo(lift)
    assert objects(lift)[4].name == "chair 2"


def test_an_object_in_many_crumbs_has_them_as_its_parts() -> None:
    assert sorted(m.parts_of(np.arange(180.0).reshape(60, 3))) == [*range(60)]


def test_points_of_a_deleted_object_take_the_label_around_them(lift: Path) -> None:
    crumb, desk = objects(lift)[CRUMB].points, objects(lift)[DESK].points
    correct(lift, lambda state, _: m.delete(state, CRUMB))
    found = objects(lift)
    assert CRUMB not in found and found[DESK].points == crumb + desk
    undo(lift)
    correct(lift, lambda state, _: m.delete(state, CRUMB, around=False))
    result = read_corrected(lift)
    assert counts(result)[TABLE, 0] == crumb and counts(result)[TABLE, DESK] == desk


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda s, _: m.rename(s, 77, "x"), "no-object 77"),
        (lambda s, _: m.rename(s, DESK, "\n"), "object-name"),
        (lambda s, _: m.reclass(s, [DESK], 99), "no-class 99"),
        (lambda s, _: m.merge(s, [DESK, DESK]), "merge-one"),
        (lambda s, free: m.split(s, DESK, m.parts_of(s.points_of(DESK)), free), "split-one-part"),
        (lambda s, _: m.assign(s, np.zeros(len(s.xyz), bool), DESK), "no-points"),
    ],
)  # fmt: skip
def test_an_impossible_correction_gives_a_one_line_error(lift: Path, make: object, line: str) -> None:
    with raises_key(line):
        correct(lift, make)  # type: ignore[arg-type]
    assert not (lift / CORRECTIONS).exists()


def test_corrections_find_objects_by_id_or_by_name(lift: Path) -> None:
    state = replayed(lift)
    name = state.objects[DESK].name
    assert {m.object_of(state, said) for said in (DESK, str(DESK), name.upper(), f"{DESK} {name}")} == {DESK}
    with raises_key("no-object sofa"):
        m.object_of(state, "sofa 1")
    other = next(number for number in state.objects if number != DESK)
    correct(lift, lambda s, _: m.rename(s, other, name))
    with raises_key("several-objects"):
        m.object_of(replayed(lift), name)


def test_an_object_without_points_cannot_be_split(lift: Path) -> None:
    state = replayed(lift)
    state.label[state.label == DESK] = 0
    part = m.parts_of(state.points_of(DESK))
    assert class_of_parts(lift, state, DESK, part) == {}
    with raises_key("split-one-part"):
        m.split(state, DESK, part, 99)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 1, "edits": [{"kind": "rename"}]}', '{"format": 1}'])
def test_a_damaged_corrections_file_gives_a_one_line_error_and_is_kept(lift: Path, text: str) -> None:
    (lift / CORRECTIONS).write_text(text)
    for act in (read_corrected, undo, lambda folder: correct(folder, merge(DESK, CRUMB))):
        with raises_key("* corrections.json"):
            act(lift)
    assert (lift / CORRECTIONS).read_text() == text


def test_doubt_of_a_class_grows_with_contradicting_masks_and_low_confidence(lift: Path) -> None:
    result = read_corrected(lift)
    segments = tuple(MatchedSegment(str(k), 1, kind, 1.0, None, 1.0, 9, 0.1, (0.0, 0.0, 1.0, 1.0))
                     for k, kind in enumerate([CHAIR] * 4 + [TABLE] * 6))  # fmt: skip
    instances = tuple(replace(one, segments=segments if one.id == DESK else ()) for one in result.made)
    for probability, doubt in ((1.0, 0.8), (0.05, 0.95)):
        points = replace(result.points, confidence=np.full_like(result.points.confidence, probability))
        found = proposals_of(replace(result, instances=instances, points=points)).open
        assert [one.doubt for one in found if one.answer == "reclass"] == [pytest.approx(doubt)]


def test_nearest_neighbour_search_matches_brute_force() -> None:
    rng = np.random.default_rng(3)
    points, queries = rng.random((300, 3)).astype(np.float32) + 50, rng.random((200, 3)).astype(np.float32) + 50
    index, distance = nearest(queries, points)
    every = np.linalg.norm(queries[:, None].astype(float) - points[None], axis=2)
    assert (index == every.argmin(axis=1)).all() and np.allclose(distance, every.min(axis=1), atol=1e-6)


_NAMES = {3: "Chair", 7: "chair", 8: "desk", 9: "lamp", 10: "rug", 12: "11", 13: "12", 14: "mat", 15: "mat"}
ALIKE = ClassTable(tuple(Category(number, name, True, (1, 2, 3)) for number, name in _NAMES.items()))


@pytest.mark.parametrize(
    ("text", "found"),
    [("chair", 7), ("Chair", 3), (" desk ", 8), ("DESK", 8), ("7", 7), ("lamp", 9), ("10", 10), ("11", 12), ("12", 13),
     ("12 11", 12), ("14", 14), ("15 mat", 15), (12, 12), (np.int64(3), 3)],
)  # fmt: skip
def test_corrections_find_a_class_by_name_or_number(text: int | str, found: int) -> None:
    assert class_of(ALIKE, text) == found


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("CHAIR", "no-class Chair chair"),
        ("mat", "no-class 14 mat 15"),
        ("sofa", "no-class sofa Chair chair desk"),
        ("99", "no-class 99"),
    ],
)
def test_an_ambiguous_class_name_is_refused(text: str, told: str) -> None:
    with raises_key(told):
        class_of(ALIKE, text)
