"""Converts a lifted scene to arrays: anchors to inspect, and Gaussians that any splat viewer can open."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..instances.panoptic_labels import LEAST_OF_CLASS, objects_of_classes
from ..machine.distinct_rows import distinct_rows
from ..result_files import Anchors
from .anchors import AnchorsInView
from .detail import widened
from .gaussians import decode_rows, no_labels
from .scene_labels import shown_labels, shown_probabilities
from .structured import LabelChannels, StructuredScene

CHUNK = 65536
"""Anchors decoded at once, to bound memory; fewer for scenes with more than USUAL_LABELS labels."""
USUAL_LABELS = 64
FLOATS = 0.12
"""Metres. A Gaussian farther than this from any observed surface, or from the next Gaussian, floats."""
FAINTEST = 0.05
"""Opacity below which a Gaussian is practically invisible."""
LEAST_COVER = 0.002
"""Minimum area of a connected group of Gaussians, in square metres weighted by opacity. A Gaussian's area is the
product of its two longest standard deviations."""
_NEIGHBOURS = 16
"""The number of Gaussians whose colours are blended, including the Gaussian itself."""


@dataclass(frozen=True, eq=False)
class BakedGaussians:
    """Gaussians decoded for one viewpoint, float32: ``means`` [N, 3] m, ``scales`` [N, 3] m, unit ``quats`` [N, 4]
    wxyz, ``opacities`` [N] in (0, 1], ``colours`` [N, 3] sRGB in [0, 1]; ``class_id``, ``instance_id`` int32 [N]."""

    means: NDArray[np.float32]
    scales: NDArray[np.float32]
    quats: NDArray[np.float32]
    opacities: NDArray[np.float32]
    colours: NDArray[np.float32]
    class_id: NDArray[np.int32]
    instance_id: NDArray[np.int32]

    def blended_colours(self) -> NDArray[np.float32]:
        """Return the visible colour around each Gaussian, sRGB float32 [N, 3] in [0, 1]: the mean over its nearest
        neighbours, weighted by opacity. A pixel blends many Gaussians, whose own colours scatter around it. Viewers
        that draw Gaussians opaque should use it."""
        if not len(self.means):
            return self.colours
        tree, blended = cKDTree(self.means), np.empty_like(self.colours)
        for start in range(0, len(self.means), CHUNK):
            rows = slice(start, start + CHUNK)
            _, near = tree.query(self.means[rows], min(_NEIGHBOURS, len(self.means)), workers=-1)
            near = near.reshape(-1, min(_NEIGHBOURS, len(self.means)))  # for one neighbour the tree returns no axis
            weights = self.opacities[near][..., None]
            blended[rows] = (weights * self.colours[near]).sum(axis=1) / weights.sum(axis=1)
        return blended

    def without_floaters(self, seen: NDArray[np.floating]) -> BakedGaussians:
        """Return the Gaussians that are opaque enough to be visible, near the points ``seen`` [P, 3], metres, and touch
        others. Where no photo saw the scene, nothing keeps Gaussians from floating in the room or far outside."""
        near, _ = cKDTree(seen).query(self.means, distance_upper_bound=FLOATS, workers=-1)
        kept = np.flatnonzero(np.isfinite(near) & (self.opacities >= FAINTEST))
        cell, group = np.floor(self.means[kept] / FLOATS).astype(np.int64), np.zeros(len(kept), np.int64)
        if len(kept):
            cells, group = distinct_rows(cell)
            beside = cKDTree(cells).query_pairs(1.8, output_type="ndarray")  # the 26 neighbours
            graph = coo_matrix((np.ones(len(beside)), tuple(beside.T)), (len(cells), len(cells)))
            group = connected_components(graph, directed=False)[1][group]
        longest = np.sort(np.minimum(self.scales[kept], FLOATS), axis=1)[:, 1:]
        cover = np.bincount(group, self.opacities[kept] * longest.prod(axis=1))
        kept = kept[cover[group] >= LEAST_COVER]
        return BakedGaussians(**{name: values[kept] for name, values in vars(self).items()})


def decided_labels(
    shown: NDArray[np.float32], channels: LabelChannels, thing_ids: frozenset[int]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return class and instance ids, int32 [N] each, from the probabilities ``shown`` [N, C + U] (see
    `shown_probabilities`), by the rule for a pixel of the passes. If each object has one class, a Gaussian without an
    object never shows a thing's class, but its next likely one."""
    classes = len(channels.class_ids)
    by_class, owned = shown[:, :classes], shown[:, classes:]
    column, rows = by_class.argmax(axis=1), np.arange(len(shown))
    class_id = np.array(channels.class_ids, np.int32)[column]
    if not owned.shape[1]:
        return class_id, np.zeros(len(class_id), np.int32)
    if channels.class_of_slot:
        own_class = np.array([channels.class_of_slot[slot] for slot in channels.instance_slots])
        found = np.full(by_class.shape, -1)  # the object of each class, if it were the Gaussian's
        for number, one in enumerate(channels.class_ids):
            least = LEAST_OF_CLASS * by_class[:, number]
            found[:, number] = objects_of_classes(
                owned, np.arange(owned.shape[1]), own_class, np.full(len(rows), one, np.int32), least
            )
        needs = np.isin(channels.class_ids, sorted(thing_ids)) & (found < 0)
        rest = np.where(needs, 0, by_class)
        column = np.where(needs[rows, column] & rest.any(axis=1), rest.argmax(axis=1), column)
        class_id, best = np.array(channels.class_ids, np.int32)[column], found[rows, column]
        is_owned = best >= 0
    else:
        best = owned.argmax(axis=1)
        is_owned = owned[rows, best] > by_class.sum(axis=1) - owned.sum(axis=1)
    is_owned &= np.isin(class_id, sorted(thing_ids))
    return class_id, np.where(is_owned, np.array(channels.shown_ids, np.int32)[best], 0).astype(np.int32)


@torch.no_grad()
def bake(
    scene: StructuredScene, viewpoint: NDArray[np.float64], thing_ids: frozenset[int]
) -> tuple[BakedGaussians, Anchors]:
    """Decode all anchors as seen from ``viewpoint`` [3], metres; return the Gaussians and the anchors. Colours and
    shapes depend slightly on the viewpoint, which splat files cannot express; the mean of the camera centres is a fair
    compromise. Gaussians keep the blur of the training pictures (see ``detail``), or viewers would show cracks in
    distant walls."""
    centre = torch.from_numpy(viewpoint.copy()).float()
    parts: list[dict[str, NDArray]] = []
    anchor_parts: list[dict[str, NDArray]] = []
    k, classes = scene.anchors.gaussians_per_anchor, len(scene.channels.class_ids)
    known = shown_labels(scene)
    without = None if known is None else no_labels(scene.anchors)
    step = CHUNK * USUAL_LABELS // max(USUAL_LABELS, classes + len(scene.channels.slot_ids))
    for start in range(0, len(scene.anchors), step):
        rows = torch.arange(start, min(start + step, len(scene.anchors)))
        decoded = decode_rows(AnchorsInView(scene.anchors, rows, centre, known_labels=without), scene.decoders)
        if known is None:
            by_class, by_slot = decoded.labels[:, :classes], decoded.labels[:, classes:]
            labels = shown_probabilities(by_class, by_slot, scene.channels).numpy()
        else:
            labels = known.of(decoded.rows(k)).numpy()
        owner, weight = (decoded.kept // k).numpy(), decoded.opacities.numpy()
        if scene.finest is not None:
            decoded = replace(decoded, scales=widened(decoded.scales, scene.finest[rows][owner]))
        class_id, instance_id = decided_labels(labels, scene.channels, thing_ids)
        names = ("means", "scales", "opacities", "colours")
        columns = {name: getattr(decoded, name).numpy() for name in names}
        quats = torch.nn.functional.normalize(decoded.quats, dim=1).numpy()
        parts.append({**columns, "quats": quats, "class_id": class_id, "instance_id": instance_id})
        part = _anchor_means(len(rows), owner, weight, decoded.colours.numpy(), labels)
        part["class_id"], part["instance_id"] = decided_labels(part.pop("labels"), scene.channels, thing_ids)
        part["opacity"] = decoded.all_opacities.clamp_min(0).mean(dim=1).numpy()
        anchor_parts.append(part)
    means = _joined(anchor_parts)
    is_drawn = means["weight"] > 0  # the other anchors get no class
    anchors = Anchors(
        xyz=scene.anchors.position.numpy(),
        class_id=np.where(is_drawn, means["class_id"], 0).astype(np.int32),
        instance_id=np.where(is_drawn, means["instance_id"], 0).astype(np.int32),
        opacity=means["opacity"],
        level=scene.anchors.level.numpy().astype(np.int32),
        rgb=np.round(means["colour"] * 255).astype(np.uint8),
    )
    return BakedGaussians(**_joined(parts)), anchors


def _joined(parts: list[dict[str, NDArray]]) -> dict[str, NDArray]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _anchor_means(
    count: int,
    owner: NDArray[np.int64],
    weight: NDArray[np.float32],
    colour: NDArray[np.float32],
    labels: NDArray[np.float32],
) -> dict[str, NDArray]:
    """Return, by name, each anchor's ``colour`` and ``labels``, means over the Gaussians that it owns (``owner`` [N])
    by opacity, and ``weight``."""
    total = np.bincount(owner, weight, count)
    safe = np.maximum(total, 1e-9)[:, None]
    mean_colour = np.stack([np.bincount(owner, weight * column, count) for column in colour.T], axis=1) / safe
    shown = np.flatnonzero(labels.any(axis=0))  # of thousands of objects, few are near these anchors
    mean_labels = np.zeros((count, labels.shape[1]))
    for column in shown:
        mean_labels[:, column] = np.bincount(owner, weight * labels[:, column], count)
    mean_labels /= safe
    means = {"weight": total, "colour": mean_colour, "labels": mean_labels}
    return {name: values.astype(np.float32) for name, values in means.items()}
