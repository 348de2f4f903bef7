"""Removing objects from a result: what is left of them, what takes their place, and what comes back."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from engine.corrections import correct, put_back, read_corrected, set_undone, undo
from engine.corrections import making as m
from engine.corrections.fills import CELL, NOTHING, Fill, cells_of, path_of, read_fill, write_fill
from tests.corrections.two_rooms import DESK, FLOOR, SOFA, write_result
from tests.raises_key import raises_key


@pytest.fixture
def lift(tmp_path: Path) -> Path:
    return write_result(tmp_path / "lift")


def patch(at: np.ndarray, label: int = -FLOOR, cells: np.ndarray = NOTHING.cells) -> Fill:
    """Gaussians of one colour at these places [P, 3], every second one a point and a guess."""
    count, second = len(at), np.arange(len(at)) % 2
    return Fill(
        cells, at.astype(np.float32), np.full((count, 3), 0.01, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)), np.full((count, 3), 0.5, np.float32),
        np.full(count, label, np.int32), second.astype(np.float32), second > 0,
    )  # fmt: skip


def removal(lift: Path, *ids: int, fill: Fill, name: str = "a1") -> object:
    digest = write_fill(path_of(lift, name), fill)
    return correct(lift, lambda state, _: m.remove(state, ids, name, digest))


def test_a_removed_object_has_no_points_and_is_listed_as_removed(lift: Path) -> None:
    before = read_corrected(lift)
    new = before.points.xyz[before.points.instance_id == DESK][:10] - 0.3
    _, now = removal(lift, DESK, fill=patch(new))
    assert DESK not in now.points.instance_id and DESK not in {one.id for one in now.instances}
    assert [one.id for one in now.removed] == [DESK]
    own = int((before.points.instance_id == DESK).sum())
    assert len(now.points.xyz) == len(before.points.xyz) - own + 5
    assert (now.points.class_id[-5:] == FLOOR).all() and (now.points.confidence[-5:] == 0.5).all()
    assert DESK not in now.anchors().instance_id
    assert read_corrected(lift).fingerprint == now.fingerprint != ""


def test_removing_an_object_clears_stuff_in_its_cells_and_keeps_other_objects(lift: Path) -> None:
    before = read_corrected(lift).points
    is_stuff = before.instance_id == 0
    everything = cells_of(before.xyz)
    _, now = removal(lift, DESK, fill=patch(np.zeros((0, 3)), cells=np.unique(everything, axis=0)))
    assert (now.points.instance_id > 0).all()
    kept = before.xyz[~is_stuff & (before.instance_id != DESK)]
    assert len(kept) and np.array_equal(now.points.xyz, kept)


def test_undo_and_put_back_restore_a_removed_object_exactly(lift: Path) -> None:
    before = read_corrected(lift)
    removal(lift, DESK, fill=patch(np.ones((4, 3))))
    _, now = undo(lift)
    assert np.array_equal(now.points.xyz, before.points.xyz) and now.removed == ()
    removal(lift, DESK, fill=patch(np.ones((4, 3))))
    edit, now = put_back(lift, [DESK])
    assert edit.kind == "remove" and now.instances == before.instances
    with raises_key("not-removed"):
        put_back(lift, [DESK])


@pytest.mark.parametrize(
    "spoil", [Path.unlink, lambda path: path.write_bytes(b"PK"), lambda path: os.truncate(path, 2**29)]
)
def test_a_removal_without_its_fill_warns_and_can_be_put_back(lift: Path, spoil: Callable[[Path], object]) -> None:
    before = read_corrected(lift)
    name = next(one.name for one in before.instances if one.id == DESK)
    removal(lift, DESK, fill=patch(np.ones((4, 3))))
    spoil(path_of(lift, "a1"))
    now = read_corrected(lift)
    assert now.removed == () and now.fingerprint == "" and f"put {name} back and remove it again" in now.warnings[0]
    edit, now = put_back(lift, [name])
    assert edit.undone and now.warnings == [] and now.instances == before.instances
    _, now = removal(lift, DESK, fill=patch(np.ones((4, 3))))
    assert [one.id for one in now.removed] == [DESK]


def test_a_removal_also_clears_the_fill_of_an_earlier_removal(lift: Path) -> None:
    place = np.array([[0.5, 0.5, 0.011], [0.53, 0.5, 0.011]])
    removal(lift, DESK, fill=patch(place))
    cells = cells_of(place)
    other = next(one.id for one in read_corrected(lift).instances)
    _, now = removal(lift, other, fill=patch(place + 0.5, cells=cells), name="b2")
    assert not (np.abs(now.points.xyz - place[1].astype(np.float32)).max(axis=1) < CELL).any()


def test_points_that_fill_a_hole_can_be_assigned_to_a_new_object(lift: Path) -> None:
    place = np.array([[0.5, 0.5, 0.0], [0.53, 0.5, 0.0]])
    removal(lift, DESK, fill=patch(place))
    near = place[1].astype(np.float32)

    def make(state, first_id):  # type: ignore[no-untyped-def]
        return m.assign(state, np.abs(state.xyz - near).max(axis=1) < 1e-3, 0, class_id=SOFA, new_id=first_id)

    edit, now = correct(lift, make)
    assert edit.made[0].id in now.points.instance_id


@pytest.mark.parametrize("damage", ["missing", "changed", "cut off"])
def test_a_removal_without_its_fill_file_is_reported_and_the_object_stays(lift: Path, damage: str) -> None:
    removal(lift, DESK, fill=patch(np.ones((4, 3))))
    path = path_of(lift, "a1")
    if damage == "missing":
        path.unlink()
    elif damage == "changed":
        write_fill(path, patch(np.ones((5, 3))))
    else:
        path.write_bytes(path.read_bytes()[:100])
    now = read_corrected(lift)
    assert DESK in now.points.instance_id and "was not applied" in now.warnings[0]


def test_a_removal_whose_fill_is_of_an_object_that_is_not_there_is_reported(lift: Path) -> None:
    def make(state, first_id):  # type: ignore[no-untyped-def]
        return m.assign(state, state.label == -FLOOR, 0, class_id=SOFA, new_id=first_id)

    made, _ = correct(lift, make)
    removal(lift, DESK, fill=patch(np.ones((4, 3)), label=made.made[0].id))
    assert [one.id for one in read_corrected(lift).removed] == [DESK]
    set_undone(lift, {made.uid: True})  # as another program may
    now = read_corrected(lift)
    assert DESK in now.points.instance_id and "unknown label" in now.warnings[0]


def test_a_fill_file_with_impossible_numbers_is_refused(tmp_path: Path) -> None:
    good = patch(np.ones((4, 3)))
    for name, value in (("scale", -good.scale), ("xyz", good.xyz * np.float32("nan")), ("label", good.label[:2])):
        write_fill(tmp_path / "one.npz", replace(good, **{name: value}))
        with raises_key("fill-damaged"):
            read_fill(tmp_path / "one.npz")
