"""The parts of a split are of the classes that their own masks give them."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from engine.corrections import class_of_parts, correct, making, read_corrected
from engine.corrections.replay import Replay
from engine.job import LiftFolder, LiftRequest
from engine.result_files import INSTANCES, MatchedSegment, read_instances, write_instances
from engine.scene import Camera, Frame, Scene
from engine.scene_of_lift import remember_scene
from tests.corrections.two_rooms import CHAIR, CHAIRS, CLASSES, SOFA, TABLE, write_result

LEFT, RIGHT, BOTH = (0.0, 0.4), (1.0, 1.4), (0.0, 1.4)
"""From where to where the two blocks of `CHAIRS` reach in x."""


def write_lift(folder: Path, *masks: tuple[tuple[float, float], int, int]) -> Path:
    """A lift whose only frame looks at the two chairs; ``masks``: what each spans in x, its class, its pixels."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[:3, 3] = 0.7, -3.0, 0.45
    camera = Camera(200, 100, 150.0, 150.0, 100.0, 50.0, pose)
    lift = LiftFolder.create(folder / "lift", LiftRequest(scene=folder / "room"))
    write_result(lift.path)

    def segment(number: int, span: tuple[float, float], kind: int, pixels: int) -> MatchedSegment:
        corners = np.array([[x, y, z] for x in span for y in (0.0, 0.4) for z in (0.1, 0.8)])
        place = camera.project(corners)[0] / camera.size
        left, top, right, bottom = (*place.min(axis=0).tolist(), *place.max(axis=0).tolist())
        return MatchedSegment("0", number, kind, 1.0, None, 1.0, pixels, 0.1, (left, top, right, bottom))

    _, made = read_instances(lift.result_path / INSTANCES)
    segments = tuple(segment(number, *mask) for number, mask in enumerate(masks))
    changed = [replace(one, segments=segments) if one.id == CHAIRS else one for one in made]
    write_instances(lift.result_path / INSTANCES, CLASSES, changed)
    frame = Frame("0", camera, False, Path("0.jpg"), None, lambda _: np.zeros((100, 200, 3), np.uint8), None, None)
    remember_scene(lift, Scene(folder / "room", (frame,), CLASSES))
    return lift.path


def kinds_after_split(lift: Path) -> dict[float, str]:
    """The class of each part by where it is in x, after a split by connected parts."""

    def make(state: Replay, first_id: int) -> object:
        part = making.parts_of(state.points_of(CHAIRS))
        return making.split(state, CHAIRS, part, first_id, class_of_parts(lift, state, CHAIRS, part))

    before = {one.id for one in read_corrected(lift).instances} - {CHAIRS}
    correct(lift, make)  # type: ignore[arg-type]
    result = read_corrected(lift)
    for one in result.instances:
        assert (result.points.class_id[result.points.instance_id == one.id] == one.class_id).all()
    return {round(one.centre[0], 1): one.class_name for one in result.instances if one.id not in before}


def test_each_part_has_the_class_of_its_own_masks(tmp_path: Path) -> None:
    masks = [(LEFT, SOFA, 50), (LEFT, CHAIR, 20), (RIGHT, TABLE, 30), (BOTH, CHAIR, 900)]
    assert kinds_after_split(write_lift(tmp_path, *masks)) == {0.2: "sofa", 1.2: "table"}


def test_without_masks_of_their_own_parts_keep_the_class(tmp_path: Path) -> None:
    assert kinds_after_split(write_lift(tmp_path, (BOTH, SOFA, 900))) == {0.2: "chair", 1.2: "chair"}
