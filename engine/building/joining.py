"""One scene from lifted blocks: what lies in the cell of each block, with all objects joined across the seams.

Neighbouring blocks are lifted from common frames, so both have points around the border between their cells. Two
objects of two blocks are the same if they hold the same of these points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..instances.oriented_box import fit_box
from ..model.anchors import Anchors
from ..model.block_decoders import BlockDecoders, BlockShape
from ..model.structured import NO_OBJECT, GaussianLabels, LabelChannels, StructuredScene
from ..result_files import Instance, SemanticPoints
from ..scene import ClassTable, distinct_colour
from ..scene.blocks import Cell

LEAST_COMMON = 5
"""The number of points that both blocks must have of an object for its parts to be joined."""
LEAST_SHARED, LEAST_OF_SMALLER = 0.5, 0.25
"""The shares of the smaller object's points that must also be the other's: of those that both blocks have, and of all
its points. Things that only touch have less in common."""


@dataclass(frozen=True, eq=False)
class LiftedBlock:
    """The result of a block's lift; its labels are voted."""

    cell: Cell
    model: StructuredScene
    points: SemanticPoints
    instances: tuple[Instance, ...]


@dataclass(frozen=True, eq=False)
class JoinedScene:
    """The whole scene, in the form that a lift of all of it would give."""

    model: StructuredScene
    points: SemanticPoints
    instances: list[Instance]


def join(blocks: Sequence[LiftedBlock], classes: ClassTable) -> JoinedScene:
    """Join blocks that were lifted in the same way. Raises ValueError if they were not."""
    if any(block.model.voted is None or not block.model.channels.class_of_slot for block in blocks):
        raise ValueError("the labels of the blocks are not voted")
    new_id = joined_ids(blocks, reach=blocks[0].model.voxel_size)
    class_of = joined_classes(blocks, new_id)
    points = joined_points(blocks, new_id, class_of)
    instances = joined_instances(blocks, new_id, class_of, points, classes)
    return JoinedScene(joined_model(blocks, new_id, class_of), points, instances)


def joined_ids(blocks: Sequence[LiftedBlock], reach: float) -> list[dict[int, int]]:
    """The new id of each object of each block, from 1, those with the most points first. Objects without a point in the
    cell of any block that has them are left out."""
    keys = _all_objects(blocks)
    places = {key: row for row, key in enumerate(keys)}
    common = [
        (count, places[first, a], places[second, b])
        for first, second in combinations(range(len(blocks)), 2)
        for (a, b), count in common_objects(blocks[first].points, blocks[second].points, reach).items()
    ]
    group = _groups([block for block, _ in keys], common)
    inside = [block.points.instance_id[block.cell.contains(block.points.xyz)] for block in blocks]
    most = max((instance for _, instance in keys), default=0)
    counts = [np.bincount(ids, minlength=most + 1) for ids in inside]
    size = np.zeros(len(places), np.int64)
    for (block, instance), row in places.items():
        size[group[row]] += counts[block][instance]
    order = [int(one) for one in np.argsort(-size, kind="stable") if size[one]]
    number = {one: place for place, one in enumerate(order, start=1)}
    found: list[dict[int, int]] = [{} for _ in blocks]
    for (block, instance), row in places.items():
        if int(group[row]) in number:
            found[block][instance] = number[int(group[row])]
    return found


def _groups(block_of: Sequence[int], common: Sequence[tuple[int, int, int]]) -> NDArray[np.int64]:
    """The group of each object, int64 [N], by pairs (common points, object, object), those with the most points first.
    Two objects that one block separates are never joined, whatever a third object has in common with both.
    """
    group = np.arange(len(block_of))
    blocks = [{block} for block in block_of]
    for _, one, other in sorted(common, key=lambda each: (-each[0], each[1:])):
        kept, joining = group[one], group[other]
        if kept != joining and not blocks[kept] & blocks[joining]:
            blocks[kept] |= blocks[joining]
            group[group == joining] = kept
    return group


def _all_objects(blocks: Sequence[LiftedBlock]) -> list[tuple[int, int]]:
    """The number of the block and the id of each object."""
    return [(number, instance.id) for number, block in enumerate(blocks) for instance in block.instances]


def common_objects(one: SemanticPoints, other: SemanticPoints, reach: float) -> dict[tuple[int, int], int]:
    """Pairs of ids of objects that are the same, with the number of points that both blocks have of them within
    ``reach`` metres of each other. Each is the other's best partner by this number."""
    if not len(one.xyz) or not len(other.xyz):
        return {}
    distance, row = cKDTree(other.xyz).query(one.xyz, distance_upper_bound=reach, workers=-1)
    both = np.isfinite(distance)
    mine, theirs = one.instance_id[both], other.instance_id[row[both]]
    of_mine, of_theirs = np.bincount(mine), np.bincount(theirs)
    all_of_mine, all_of_theirs = np.bincount(one.instance_id), np.bincount(other.instance_id)
    pairs, count = np.unique(np.stack([mine, theirs], 1), axis=0, return_counts=True)
    table = {(int(a), int(b)): int(n) for (a, b), n in zip(pairs, count, strict=True) if a and b}
    best_of_mine = _best_partners(table)
    best_of_theirs = _best_partners({(b, a): n for (a, b), n in table.items()})
    return {
        (a, b): n
        for (a, b), n in table.items()
        if best_of_mine[a] == b
        and best_of_theirs[b] == a
        and n >= max(LEAST_COMMON, LEAST_SHARED * min(of_mine[a], of_theirs[b]))
        and n >= LEAST_OF_SMALLER * min(all_of_mine[a], all_of_theirs[b])
    }


def _best_partners(table: Mapping[tuple[int, int], int]) -> dict[int, int]:
    """The object that has the most points in common with each; the lower id if several tie."""
    return {a: b for (a, b), _ in sorted(table.items(), key=lambda item: (item[1], -item[0][1]))}


def joined_classes(blocks: Sequence[LiftedBlock], new_id: Sequence[Mapping[int, int]]) -> dict[int, int]:
    """The class of each new id: the class of most points of its parts, the lower one if several tie."""
    votes: dict[int, dict[int, int]] = {}
    for block, ids in zip(blocks, new_id, strict=True):
        for instance in block.instances:
            if instance.id in ids:
                own = votes.setdefault(ids[instance.id], {})
                own[instance.class_id] = own.get(instance.class_id, 0) + instance.points
    return {one: max(sorted(own), key=lambda class_id: own[class_id]) for one, own in sorted(votes.items())}


def joined_points(
    blocks: Sequence[LiftedBlock], new_id: Sequence[Mapping[int, int]], class_of: Mapping[int, int]
) -> SemanticPoints:
    """The points of every block that lie in its cell, with the new ids."""
    parts = []
    for block, ids in zip(blocks, new_id, strict=True):
        points, inside = block.points, block.cell.contains(block.points.xyz)
        table = np.zeros(int(points.instance_id.max(initial=0)) + 1, np.int32)
        for old, new in ids.items():
            if old < len(table):
                table[old] = new
        instance_id = table[points.instance_id[inside]]
        own = np.array([0, *(class_of[one] for one in sorted(class_of))], np.int32)[instance_id]
        class_id = np.where(instance_id > 0, own, points.class_id[inside]).astype(np.int32)
        parts.append((points.xyz[inside], points.rgb[inside], class_id, instance_id, points.confidence[inside]))
    return SemanticPoints(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def joined_instances(
    blocks: Sequence[LiftedBlock],
    new_id: Sequence[Mapping[int, int]],
    class_of: Mapping[int, int],
    points: SemanticPoints,
    classes: ClassTable,
) -> list[Instance]:
    """The objects, each with the masks of all its parts, and a box around all its points."""
    parts: dict[int, list[Instance]] = {one: [] for one in class_of}
    for block, ids in zip(blocks, new_id, strict=True):
        for instance in block.instances:
            if instance.id in ids:
                parts[ids[instance.id]].append(instance)
    thickness, counts, found = blocks[0].model.voxel_size, dict[int, int](), []
    order = np.argsort(points.instance_id, kind="stable")
    ends = np.searchsorted(points.instance_id[order], np.arange(max(class_of, default=0) + 2))
    for one, own in parts.items():
        class_id = class_of[one]
        counts[class_id] = counts.get(class_id, 0) + 1
        xyz = points.xyz[order[ends[one] : ends[one + 1]]]
        box = fit_box(xyz, thickness)
        x, y, z = box.centre.tolist()
        length, width, height = box.size.tolist()
        segments = {(each.frame, each.segment_id): each for part in own for each in part.segments}
        weight = np.array([max(part.points, 1) for part in own], np.float64)
        found.append(
            Instance(
                id=one,
                name=f"{classes[class_id].name} {counts[class_id]}",
                class_id=class_id,
                class_name=classes[class_id].name,
                colour=distinct_colour(one),
                centre=(x, y, z),
                size=(length, width, height),
                yaw=box.yaw,
                rotation=box.rotation,
                views=len({frame for frame, _ in segments}),
                score=float(np.average([part.score for part in own], weights=weight)),
                points=len(xyz),
                segments=tuple(segments[key] for key in sorted(segments)),
            )
        )
    return found


def joined_model(
    blocks: Sequence[LiftedBlock], new_id: Sequence[Mapping[int, int]], class_of: Mapping[int, int]
) -> StructuredScene:
    """The Gaussians of every block whose anchors lie in its cell. Each block's have their own decoders."""
    class_ids = tuple(sorted({each for block in blocks for each in block.model.channels.class_ids}))
    channels = LabelChannels(class_ids, (NO_OBJECT, *class_of), (0, *class_of.values()))
    place = {-class_id: row for row, class_id in enumerate(class_ids)}
    place |= {one: len(class_ids) + row for row, one in enumerate(channels.shown_ids)}
    anchors, labels, shares, finest = [], [], [], []
    most = max(block.model.voted.label.shape[1] for block in blocks if block.model.voted)
    for block, ids in zip(blocks, new_id, strict=True):
        model, k = block.model, block.model.anchors.gaussians_per_anchor
        rows = torch.from_numpy(block.cell.contains(model.anchors.position.numpy()).nonzero()[0])
        anchors.append(model.anchors.select(rows))
        finest.append(torch.zeros(len(rows)) if model.finest is None else model.finest[rows])
        drawn = (rows[:, None] * k + torch.arange(k)).flatten()
        own = model.channels
        of_shown = own.class_of_shown
        codes = [*(-one for one in own.class_ids), *(ids.get(one, -of_shown[one]) for one in own.shown_ids)]
        meaning = torch.tensor([place[code] for code in codes], dtype=torch.int16)
        assert model.voted is not None
        missing = (0, most - model.voted.label.shape[1])
        label = meaning[model.voted.label[drawn].long()]
        labels.append(torch.nn.functional.pad(label, missing))
        shares.append(torch.nn.functional.pad(model.voted.share[drawn], missing))
    whole = Anchors(**{name: torch.cat([part.tensors()[name] for part in anchors]) for name in anchors[0].tensors()})
    first = blocks[0].model.decoders.shape
    sizes = first.features, first.gaussians_per_anchor, len(class_ids), len(channels.slot_ids)
    shape = BlockShape(*sizes, first.distance_input, first.label_view_input, tuple(len(part) for part in anchors))
    decoders = BlockDecoders.joined(shape, [block.model.decoders for block in blocks])
    voted = GaussianLabels(torch.cat(labels), torch.cat(shares))
    return StructuredScene(whole, decoders, channels, blocks[0].model.voxel_size, voted, torch.cat(finest))
