"""Objects on both sides of a wall between cells are one where the blocks' points say so."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from engine.building import joining
from engine.building.joining import LiftedBlock, common_objects, join
from engine.instances.oriented_box import fit_box
from engine.model.anchors import initial_anchors
from engine.model.decoders import Decoders, DecoderShape
from engine.model.structured import NO_OBJECT, GaussianLabels, LabelChannels, StructuredScene
from engine.result_files import Instance, SemanticPoints
from engine.scene import Category, ClassTable
from engine.scene.blocks import Cell

FLOOR, CHAIR, TABLE = 1, 5, 7
NAMES = {FLOOR: "floor", CHAIR: "chair", TABLE: "table"}
CLASSES = ClassTable(tuple(Category(one, name, one > FLOOR, (one, 9, 9)) for one, name in NAMES.items()))
LEFT = Cell(np.array([-np.inf, -np.inf]), np.array([0.0, np.inf]))
RIGHT = Cell(np.array([0.0, -np.inf]), np.array([np.inf, np.inf]))


def cube(x: float) -> NDArray[np.float32]:
    """Points of a cube of 0.4 m whose middle is at ``x``."""
    axis = np.linspace(-0.2, 0.2, 5)
    return (np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3) + [x, 0.0, 0.2]).astype(np.float32)


def block(cell: Cell, objects: list[tuple[float, int]]) -> LiftedBlock:
    """A block with a floor and these objects: where each is, and its class. Their ids count from 1."""
    floor = np.stack(np.meshgrid(np.arange(-2, 2, 0.1), np.arange(-1, 1, 0.1), [0.0]), -1).reshape(-1, 3)
    parts = [floor.astype(np.float32), *(cube(x) for x, _ in objects)]
    class_id = np.repeat([FLOOR, *(kind for _, kind in objects)], [len(part) for part in parts]).astype(np.int32)
    instance = np.repeat(np.arange(len(parts)), [len(part) for part in parts]).astype(np.int32)
    xyz = np.concatenate(parts)
    points = SemanticPoints(xyz, np.zeros(xyz.shape, np.uint8), class_id, instance, np.ones(len(xyz), np.float32))
    listed = tuple(listed_object(number, xyz[instance == number], kind) for number, (_, kind) in enumerate(objects, 1))
    kinds = tuple(kind for _, kind in objects)
    channels = LabelChannels((FLOOR, CHAIR, TABLE), (NO_OBJECT, *range(1, len(kinds) + 1)), (0, *kinds))
    shape = DecoderShape(4, 2, 3, len(kinds) + 1, distance_input=False, label_view_input=False)
    feature = np.zeros((len(xyz), 4), np.float32)
    anchors = initial_anchors(xyz, class_id, gaussians_per_anchor=2, feature=feature, voxel_size=0.1)
    code = np.where(instance > 0, instance + 2, 0).repeat(2)[:, None].astype(np.int16)
    voted = GaussianLabels(torch.from_numpy(code), torch.ones(len(code), 1))
    return LiftedBlock(cell, StructuredScene(anchors, Decoders(shape, 0), channels, 0.1, voted), points, listed)


def listed_object(number: int, xyz: NDArray[np.float32], kind: int) -> Instance:
    box = fit_box(xyz, 0.1)
    centre, size = tuple(box.centre.tolist()), tuple(box.size.tolist())
    return Instance(number, "x", kind, "x", (1, 2, 3), centre, size, 0.0, (1.0, 0.0, 0.0, 0.0), 3, 1.0, len(xyz), ())


def test_an_object_on_the_wall_is_one() -> None:
    whole = join([block(LEFT, [(-1.0, CHAIR), (0.0, TABLE)]), block(RIGHT, [(0.0, TABLE), (1.0, CHAIR)])], CLASSES)
    assert sorted(one.name for one in whole.instances) == ["chair 1", "chair 2", "table 1"]
    table = next(one for one in whole.instances if one.class_id == TABLE)
    assert np.allclose(table.size, 0.4, atol=0.02) and table.points == len(cube(0.0))
    own = whole.points.xyz[whole.points.instance_id == table.id]
    assert (own[:, 0] < 0).any() and (own[:, 0] > 0).any()


def test_two_objects_of_a_block_never_become_one() -> None:
    # Object 3 of the second block has something in common with both objects of the first.
    assert joining._groups([0, 0, 1], [(40, 0, 2), (50, 1, 2)]).tolist() == [0, 1, 1]
    # The chain A1 - B - C - A2 breaks at its weakest link.
    assert joining._groups([0, 0, 1, 2], [(90, 0, 2), (20, 2, 3), (80, 3, 1)]).tolist() == [0, 3, 0, 3]


def test_an_object_beyond_the_wall_belongs_to_its_own_block() -> None:
    whole = join([block(LEFT, [(-1.0, CHAIR), (1.0, TABLE)]), block(RIGHT, [(1.6, CHAIR)])], CLASSES)
    assert sorted(one.name for one in whole.instances) == ["chair 1", "chair 2"]  # the table is not where LEFT counts
    beyond = whole.points.xyz[:, 0] > 0
    assert set(whole.points.class_id[beyond]) == {FLOOR, CHAIR}


def test_the_part_with_more_points_names_the_class() -> None:
    left = block(LEFT, [(-0.1, CHAIR)])
    right = block(RIGHT, [(-0.1, TABLE)])
    many = left.instances[0].__class__(**{**vars(right.instances[0]), "points": 9999})
    whole = join([left, LiftedBlock(RIGHT, right.model, right.points, (many,))], CLASSES)
    (one,) = whole.instances
    assert one.class_id == TABLE
    assert set(whole.points.class_id[whole.points.instance_id == one.id]) == {TABLE}


def test_each_gaussian_keeps_its_object() -> None:
    whole = join([block(LEFT, [(0.0, TABLE)]), block(RIGHT, [(1.0, CHAIR), (0.0, TABLE)])], CLASSES)
    model = whole.model
    assert model.voted is not None and len(model.anchors) == len(whole.points.xyz)
    codes = np.array([*(-one for one in model.channels.class_ids), *model.channels.shown_ids])
    shown = codes[model.voted.label[::2, 0].numpy()]
    assert (shown == np.where(whole.points.instance_id > 0, whole.points.instance_id, -whole.points.class_id)).all()


def test_a_crumb_is_not_joined_to_what_it_touches() -> None:
    one, other = block(LEFT, [(-0.5, CHAIR)]), block(RIGHT, [(-0.1, TABLE)])
    assert common_objects(one.points, other.points, reach=0.02) == {}
