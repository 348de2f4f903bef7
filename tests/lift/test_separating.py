"""Masks of a few frames say what an object falls into, whatever the others merge."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from engine.errors import Cancelled
from engine.lift.separating import parts_by_views
from engine.scene import Camera, Frame, PanopticMask, Segment

CHAIR, SOFA, WALL = 2, 4, 1
ONE = (Segment(1, CHAIR, True),)
TWO = (Segment(1, CHAIR, True), Segment(2, SOFA, True))


def board() -> NDArray[np.float32]:
    """Points of an upright board, 2 m wide and 3 m before the cameras: no gap is in it."""
    x, z = np.meshgrid(np.arange(-0.975, 1, 0.05), np.arange(-0.475, 0.5, 0.05))
    return np.stack([x, np.full_like(x, 3.0), z], axis=-1).reshape(-1, 3).astype(np.float32)


def frame(name: str, at: float, edge: float | None, segments: tuple[Segment, ...]) -> Frame:
    """A view of the board from x = ``at``. What lies right of ``edge`` is its segment 2."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[0, 3] = at
    camera = Camera(120, 60, 100.0, 100.0, 60.0, 30.0, pose)
    x = at + (np.arange(120) + 0.5 - 60) * 3.0 / 100
    ids = np.broadcast_to(np.where(x > (9 if edge is None else edge), 2, 1).astype(np.int32), (60, 120))
    depth = np.full((60, 120), 3.0, np.float32)
    return Frame(
        name, camera, False, Path(name), None, lambda _: np.zeros((60, 120, 3), np.uint8), lambda _: depth,
        lambda _: PanopticMask(ids, segments),
    )  # fmt: skip


def test_two_frames_that_show_two_objects_outvote_many_that_show_one() -> None:
    xyz = board()
    frames = [frame(f"{at}", at, None, ONE) for at in np.linspace(-0.5, 0.5, 7)]
    assert not parts_by_views(frames, xyz).class_of
    frames += [frame("a", -0.2, 0.4, TWO)]
    assert not parts_by_views(frames, xyz).class_of  # a single mask may be wrong
    found = parts_by_views([*frames, frame("b", 0.3, 0.4, TWO)], xyz)
    assert (found.part == (xyz[:, 0] > 0.4)).all()
    assert found.class_of == {0: CHAIR, 1: SOFA} and found.frames == 2


def test_stuff_and_hidden_points_do_not_vote_when_an_object_is_split() -> None:
    wall = (Segment(1, CHAIR, True), Segment(2, WALL, False))
    assert not parts_by_views([frame(f"{at}", at, 0.4, wall) for at in (-0.2, 0.3)], board()).class_of
    frames = [frame(f"{at}", at, 0.4, TWO) for at in (-0.2, 0.3)]
    hidden = [replace(one, read_depth=lambda _: np.full((60, 120), 1.0, np.float32)) for one in frames]
    assert not parts_by_views(hidden, board()).class_of
    assert not parts_by_views([], board()).class_of


@pytest.mark.parametrize("stops_after", [1, 3])
def test_splitting_an_object_by_views_can_be_stopped(stops_after: int) -> None:
    read: list[str] = []
    frames = [frame(f"{at}", at, 0.4, TWO) for at in (-0.2, 0.0, 0.3)]
    noting = [replace(one, read_mask=lambda size, one=one: read.append(one.name) or one.mask(size)) for one in frames]

    def told(done: int, count: int) -> None:
        assert count == 3
        if done == stops_after:
            raise Cancelled("asked")

    with pytest.raises(Cancelled):
        parts_by_views(noting, board(), told)
    assert read == ["-0.2", "0.0", "0.3"][:stops_after]


@pytest.mark.parametrize("seed", range(3))
def test_splitting_by_inexact_masks_puts_95_percent_of_points_right(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = [frame(f"{at}", at, 0.1 + 0.05 * rng.standard_normal(), TWO) for at in np.linspace(-0.6, 0.6, 9)]
    part = parts_by_views(frames, xyz := board()).part
    right = (part == part[xyz[:, 0].argmax()]) == (xyz[:, 0] > 0.1)
    assert len(np.unique(part)) == 2 and right.mean() > 0.95
