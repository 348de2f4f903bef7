"""The lifted scene with its corrections: every Gaussian has the labels that remain after the edits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from ..corrections import CorrectedResult
from ..model.structured import GaussianLabels, LabelChannels, StructuredScene

KEPT = 6
"""Labels that are corrected per Gaussian if decoders gave it a probability for every label."""
CHUNK = 16384
"""Anchors that are decoded at once."""


@torch.no_grad()
def corrected_scene(scene: StructuredScene, corrected: CorrectedResult) -> StructuredScene:
    """The scene with the classes and objects of ``corrected``. Its Gaussians keep only their likeliest labels, as if
    the views had voted, and each object has one class. A scene whose labels no edit changes is returned as it is.
    """
    if not corrected.changes_labels:
        return scene
    channels = scene.channels
    codes = np.array([*(-one for one in channels.class_ids), *channels.shown_ids], np.int32)
    voted = scene.voted or _likeliest(scene, corrected)
    means, k = _means(scene).numpy(), voted.label.shape[1]
    before = codes[voted.label.numpy().astype(np.int64)]
    after = np.stack([corrected.relabelling.of(means, before[:, place]) for place in range(k)], axis=1)
    kinds = {one.id: one.class_id for one in corrected.instances}
    # An object without any point keeps its slot and its class.
    own = dict(zip(channels.shown_ids, _classes_of_slots(channels, corrected), strict=True))
    shown = sorted({*np.unique(after[after > 0]).tolist(), *(one for one in kinds if one in own)})
    of_shown = [kinds.get(one, own.get(one, 0)) for one in shown]
    class_ids = tuple(sorted({*channels.class_ids, *of_shown, *(-after[after < 0]).tolist()} - {0}))
    changed = LabelChannels(class_ids, tuple(shown), tuple(of_shown))
    places = {code: place for place, code in enumerate([*(-one for one in class_ids), *shown])}
    known = np.array(sorted(places), np.int32)
    label = np.array([places[code] for code in known.tolist()], np.int16)[np.searchsorted(known, after)]
    return replace(scene, channels=changed, voted=GaussianLabels(torch.from_numpy(label), voted.share))


def _classes_of_slots(channels: LabelChannels, corrected: CorrectedResult) -> list[int]:
    """The class of each shown instance, as the engine decided it."""
    if channels.class_of_slot:
        return [channels.class_of_slot[slot] for slot in channels.instance_slots]
    kinds = {one.id: one.class_id for one in corrected.made}
    return [kinds.get(one, channels.class_ids[0]) for one in channels.shown_ids]


def _means(scene: StructuredScene) -> torch.Tensor:
    """The positions of all Gaussians, float32 [M k, 3] metres, which do not depend on the view."""
    anchors = scene.anchors
    moved = anchors.offset * anchors.log_scale[:, None, :3].exp()
    return (anchors.position[:, None] + moved).flatten(0, 1).float()


def _likeliest(scene: StructuredScene, corrected: CorrectedResult) -> GaussianLabels:
    """The likeliest labels that the decoders give each Gaussian."""
    labels, shares = zip(*_likeliest_of_chunks(scene, corrected), strict=True)
    return GaussianLabels(torch.cat(labels), torch.cat(shares))


def _likeliest_of_chunks(
    scene: StructuredScene, corrected: CorrectedResult
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """If each pixel decides on its own, it shows an object only where it shows a thing. There the objects get no more
    than the things' share. Labels that depend on the view are those seen from the middle of the scene."""
    anchors, decoders, channels = scene.anchors, scene.decoders, scene.channels
    centre, things = anchors.position.mean(dim=0), corrected.classes.thing_ids
    is_thing = torch.tensor([one in things for one in channels.class_ids])
    for rows in torch.arange(len(anchors)).split(CHUNK):
        feature, position = anchors.feature[rows], anchors.position[rows]
        outputs = decoders.label_logits(feature, decoders.view_input(feature, position, centre))
        classes, slots = (logits.flatten(0, 1).softmax(dim=1) for logits in outputs)
        instances = slots[:, list(channels.instance_slots)]
        owned = instances.sum(dim=1, keepdim=True)
        if channels.class_of_slot:
            alone = classes * (1 - owned)
        else:
            instances = instances * (classes * is_thing).sum(dim=1, keepdim=True)
            alone = torch.where(is_thing, classes * (1 - owned), classes)
        every = torch.cat([alone, instances], dim=1)
        share, label = every.topk(min(KEPT, every.shape[1]), dim=1)
        yield label.to(torch.int16), share
