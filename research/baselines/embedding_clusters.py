"""After contrastive training: the embeddings that the training views show of things are clustered, and each cluster is
an instance (Contrastive Lift). A pixel belongs to the instance whose cluster's centre is nearest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from engine.model.gaussians import decode, no_labels
from engine.model.scene_labels import scene_labels
from engine.model.structured import NO_OBJECT, LabelChannels, StructuredScene
from engine.scene import Camera, View

from .density_clusters import density_clusters
from .encodings import EncodedDecoders, EncodedLabels, EncodedShape

Progress = Callable[[int, int], object]
"""Called with (done, total) after each view."""
CLUSTERED = 5000
"""How many pixels' embeddings are clustered, and at most how many from one view."""
LEAST_SHARE = 0.01
"""A cluster has at least this share of them."""

OPAQUE = 0.5
"""Pixels of which less than this is drawn say nothing."""
FARTHEST = 3.0
"""Standard deviations from the mean, beyond which an embedding is left out."""
SHARPNESS = 200.0
"""How surely a pixel belongs to the nearest centre: exp(-SHARPNESS d^2), where the embeddings lie within 0..1."""
NEVER = -1e5
"""Logit of "no object": a pixel of a thing always has an instance."""
LEAST_WIDTH = 1e-2
"""A channel narrower than this is not stretched further when channels are scaled to a width of 1."""


class Centres(NamedTuple):
    """``centre`` float64 [K, E] of the clusters, and the ``scale`` [E] by which distances to them are stretched."""

    centre: NDArray[np.float64]
    scale: NDArray[np.float64]


def with_clusters(
    scene: StructuredScene,
    views: Sequence[View],
    thing_ids: frozenset[int],
    seed: int,
    progress: Progress = lambda done, total: None,
) -> StructuredScene:
    """The scene with an instance for each cluster, and a classifier that finds it, without the slow decoder."""
    found = cluster_centres(thing_embeddings(scene, views, thing_ids, seed, progress))
    slots = (*range(1, len(found.centre) + 1), NO_OBJECT)
    shape = EncodedShape(**{**vars(scene.decoders.shape), "instance_slots": len(slots)})
    decoders = EncodedDecoders(shape, seed)
    own = {key: value for key, value in scene.decoders.state_dict().items() if not key.startswith(("slow", "class"))}
    decoders.load_state_dict(own | classifier_of(found))
    return replace(scene, decoders=decoders, channels=LabelChannels(scene.channels.class_ids, slots))


def classifier_of(found: Centres) -> dict[str, torch.Tensor]:
    """Weights of a linear classifier whose logits differ as -SHARPNESS d^2 does, d being the distances to the centres;
    and one for no object."""
    middle = found.centre.mean(axis=0) if len(found.centre) else np.zeros_like(found.scale)
    scaled = (found.centre - middle) * found.scale
    weight = 2 * SHARPNESS * scaled * found.scale
    bias = -SHARPNESS * (scaled**2).sum(axis=1) - weight @ middle
    parts = {"weight": np.vstack([weight, np.zeros_like(found.scale)]), "bias": np.append(bias, NEVER)}
    return {f"classifier.{name}": torch.from_numpy(part).float() for name, part in parts.items()}


def cluster_centres(embedding: NDArray[np.float64]) -> Centres:
    """The clusters of embeddings [N, E], without outliers and with each channel scaled to a width of 1."""
    none = Centres(np.zeros((0, embedding.shape[1])), np.ones(embedding.shape[1]))
    if not len(embedding):
        return none
    mean, deviation = embedding.mean(axis=0), embedding.std(axis=0)
    usual = embedding[(np.abs(embedding - mean) <= FARTHEST * deviation).all(axis=1)]
    if not len(usual):
        return none
    scale = 1.0 / np.maximum(np.ptp(usual, axis=0), LEAST_WIDTH)
    label = density_clusters(usual * scale, max(2, round(LEAST_SHARE * len(usual))))
    centres = [usual[label == number].mean(axis=0) for number in range(int(label.max()) + 1)]
    return Centres(np.reshape(centres, (len(centres), embedding.shape[1])), scale)


@torch.no_grad()
def thing_embeddings(
    scene: StructuredScene,
    views: Sequence[View],
    thing_ids: frozenset[int],
    seed: int,
    progress: Progress = lambda done, total: None,
) -> NDArray[np.float64]:
    """Fast embeddings [N, E] of at most CLUSTERED pixels that are shown as things. ``progress`` is called after each
    view; what it raises ends this."""
    labels = scene_labels(scene)
    assert isinstance(labels, EncodedLabels)  # it has embeddings
    random = np.random.default_rng([seed, 5])
    parts = []
    for done, view in enumerate(views, start=1):
        shown = _of_things(scene, labels, view.camera, thing_ids)
        progress(done, len(views))
        parts.append(shown[random.permutation(len(shown))[:CLUSTERED]])
    every = np.concatenate(parts)
    return every[random.permutation(len(every))[:CLUSTERED]]


def _of_things(
    scene: StructuredScene, labels: EncodedLabels, camera: Camera, thing_ids: frozenset[int]
) -> NDArray[np.float64]:
    """The fast embeddings of the pixels that are shown as things, [P, E]."""
    drawn = decode(scene.anchors, scene.decoders, camera, known_labels=no_labels(scene.anchors))
    rendering = drawn.drawn_by(camera, labels.of(drawn.rows(scene.anchors.gaussians_per_anchor)))
    assert rendering.labels is not None  # drawn with labels
    class_ids = np.array(scene.channels.class_ids)
    first, last = len(class_ids), len(class_ids) + scene.decoders.shape.encoding
    shown = class_ids[rendering.labels[..., :first].argmax(dim=-1).numpy()]
    alpha = rendering.alpha.numpy()
    is_thing = np.isin(shown, sorted(thing_ids)) & (alpha > OPAQUE)
    blended = rendering.labels[..., first:last].numpy().astype(np.float64)
    return blended[is_thing] / alpha[is_thing][:, None]
