"""Lets the masks of all views vote on each Gaussian's label. The label decoders are small networks, and blur small
things: taps, switches, the edge of a stair. The masks are sharper. So the label of each pixel is a vote for the
Gaussians that are blended there, in proportion to their blending weights. (LUDVIG, Marrie et al. 2024, averages a
network's features this way.) Gaussians that no view saw keep their decoded labels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..instances.panoptic_labels import LEAST_OF_CLASS, object_of_class
from ..machine.compiled import compiled, device_function
from ..presets.preset import EvidenceKind
from ..scene import Camera, resolution_on
from ..scene.evidence import evidence_of_pixels, evidence_of_resolution
from .gaussians import decode, no_labels
from .structured import GaussianLabels, StructuredScene

LEAST_SHARE = np.float32(LEAST_OF_CLASS)
LABELS_HELD = 16
"""The most labels that a Gaussian holds votes for at once. It lies on one surface, so few labels get votes."""
CHUNK = 16384
"""Anchors whose labels are decoded at once, to bound the memory; fewer for more than USUAL_LABELS labels."""
USUAL_LABELS = 64
CONTRIBUTORS = 4
"""The number of Gaussians that get a pixel's vote."""
DEPTH_GAP_M, DEPTH_GAP_SHARE = 0.15, 0.05
"""Metres and share of depth. A pixel abstains if its rendered depth differs from the sensor's by more than both."""
PRIOR = 0.3
"""The votes of the label decoders on each Gaussian."""
KEPT = 4
"""The number of labels that a Gaussian keeps."""


@dataclass(frozen=True, eq=False)
class Contributors:
    """The Gaussians that a view's pixels are blended from, largest weight first: ``gaussian`` int32 [H, W, K], rows of
    the scene's labels (-1 = none), and ``weight`` float32 [H, W, K]. ``depth`` float32 [H, W], metres, is 0 where
    (almost) nothing is drawn. ``camera`` is the view's."""

    gaussian: NDArray[np.int32]
    weight: NDArray[np.float32]
    depth: NDArray[np.float32]
    camera: Camera


class HeldVotes(NamedTuple):
    """The labels with votes for each Gaussian, int16 [G, L] (-1 = none yet), and the votes' sums, float32 [G, L]."""

    label: NDArray[np.int16]
    votes: NDArray[np.float32]

    def of_all_labels(self, start: int, stop: int, labels: int) -> NDArray[np.float32]:
        """Return the votes as a dense array, float32 [n, ``labels``], for Gaussians ``start`` to before ``stop``."""
        dense = np.zeros((stop - start, labels), np.float32)
        row, column = np.nonzero(self.label[start:stop] >= 0)
        dense[row, self.label[start:stop][row, column]] = self.votes[start:stop][row, column]
        return dense


@torch.no_grad()
def contributors(scene: StructuredScene, camera: Camera, count: int = CONTRIBUTORS) -> Contributors:
    """Return the ``count`` Gaussians with the largest blending weights in each pixel of the view."""
    drawn = decode(scene.anchors, scene.decoders, camera, known_labels=no_labels(scene.anchors))
    rendering = drawn.drawn_by(camera, top_k=count)
    assert rendering.top_indices is not None and rendering.top_weights is not None  # as requested
    row = torch.cat([drawn.rows(scene.anchors.gaussians_per_anchor), torch.tensor([-1])])  # the last is for -1, none
    alpha = rendering.alpha.numpy()
    depth = np.divide(rendering.depth.numpy(), alpha, out=np.zeros_like(alpha), where=alpha > 0.3)
    gaussian = row.to(torch.int32)[rendering.top_indices.long()]
    return Contributors(gaussian.numpy(), rendering.top_weights.numpy(), depth, camera)


class LabelVotes:
    """Counts the views' votes on the labels of a finished scene's G Gaussians. A Gaussian holds votes for at most
    LABELS_HELD labels, so that memory does not grow with the number of labels. A further label replaces the label with
    the fewest votes, and takes over its votes ("space saving", Metwally et al. 2005), so a label with more than 1 /
    LABELS_HELD of a Gaussian's votes is never lost."""

    def __init__(self, scene: StructuredScene, kind: EvidenceKind, prior: float = PRIOR) -> None:
        self.scene, self.kind, self.prior = scene, kind, prior
        channels = scene.channels
        self._labels = len(channels.class_ids) + len(channels.instance_slots)
        gaussians = len(scene.anchors) * scene.anchors.gaussians_per_anchor
        held = min(LABELS_HELD, self._labels)
        self._held = HeldVotes(np.full((gaussians, held), -1, np.int16), np.zeros((gaussians, held), np.float32))
        self._seen = np.zeros(gaussians, np.float32)

    def add(
        self, view: Contributors, label: NDArray[np.int16], sensor: NDArray[np.float32], mask_scale: float = 1.0
    ) -> None:
        """Count a view's votes: ``label`` int16 [H, W] (-1 = no vote). Pixels whose rendered depth contradicts
        ``sensor`` float32 [H, W], metres (0 = unknown), do not vote. Pixels are ``mask_scale`` mask pixels wide."""
        gap = np.maximum(DEPTH_GAP_M, DEPTH_GAP_SHARE * sensor)
        votes = (label >= 0) & ((sensor <= 0) | (np.abs(view.depth - sensor) <= gap))
        shown = np.where(votes, label, -1).astype(np.int16)
        power = evidence_of_pixels(self.kind)
        word = evidence_of_resolution(self.kind, resolution_on(view.camera, view.depth, mask_scale))
        word *= np.float32(mask_scale ** (2 * power))
        _add_votes(view.gaussian, view.weight, shown, word, np.float32(power), self._seen, self._held)

    @torch.no_grad()
    def result(self) -> GaussianLabels:
        """Return the likeliest labels of each Gaussian, with the decoders' as further votes. Shares sum to 1."""
        k, kept, decoders = self.scene.anchors.gaussians_per_anchor, min(KEPT, self._labels), self.scene.decoders
        parts = []
        step = CHUNK * USUAL_LABELS // max(USUAL_LABELS, self._labels)
        for start in range(0, len(self.scene.anchors), step):
            feature = self.scene.anchors.feature.detach()[start : start + step]
            votes = torch.from_numpy(self._held.of_all_labels(start * k, (start + len(feature)) * k, self._labels))
            if not decoders.shape.label_view_input:  # otherwise they need a view
                logits = decoders.label_logits(feature, feature)
                classes, slots = (each.flatten(0, 1).softmax(dim=1) for each in logits)
                instances = slots[:, list(self.scene.channels.instance_slots)]
                alone = classes * (1 - instances.sum(dim=1, keepdim=True))
                votes = votes + self.prior * torch.cat([alone, instances], dim=1)
            parts.append(votes.topk(kept, dim=1))
        share = torch.cat([part.values for part in parts])
        label = torch.cat([part.indices for part in parts]).to(torch.int16)
        return GaussianLabels(label, share / share.sum(dim=1, keepdim=True).clamp_min(1e-8))


def pixel_labels(scene: StructuredScene, voted: GaussianLabels, view: Contributors) -> NDArray[np.int16]:
    """Return the label that each pixel shows, int16 [H, W], -1 where (almost) nothing is drawn. As for the passes, the
    class is decided first, then the object among those of that class."""
    channels = scene.channels
    classes = len(channels.class_ids)
    of_instance = [channels.class_ids.index(channels.class_of_slot[slot]) for slot in channels.instance_slots]
    class_of_object, object_labels = np.array(of_instance, np.int64), np.arange(len(of_instance)) + classes
    out = np.full(view.depth.shape, -1, np.int16)
    few = voted.label.numpy(), voted.share.numpy()
    _decide_pixels(view.gaussian, view.weight, *few, class_of_object, object_labels, classes, out)
    return out


@device_function
def _add_vote(labels: Any, votes: Any, label: Any, amount: Any) -> None:
    """Add ``amount`` votes for ``label`` to the labels and votes [L] that one Gaussian holds."""
    least = 0
    for column in range(len(labels)):
        if labels[column] == label or labels[column] < 0:
            labels[column] = label
            votes[column] += amount
            return
        if votes[column] < votes[least]:
            least = column
    labels[least] = label
    votes[least] += amount


@compiled
def _add_votes(gaussian: Any, weight: Any, label: Any, word: Any, power: Any, seen: Any, held: HeldVotes) -> None:
    """Add a view's votes to ``held``. A Gaussian with total weight w in the view gets w^``power`` votes, times the mean
    over its pixels of ``word`` [H, W], a pixel's resolution factor. ``seen`` [G]: zeros, before and after."""
    height, width, count = weight.shape
    for y in range(height):
        for x in range(width):
            if label[y, x] >= 0:
                for c in range(count):
                    if gaussian[y, x, c] >= 0:
                        seen[gaussian[y, x, c]] += weight[y, x, c]
    for y in range(height):
        for x in range(width):
            if label[y, x] >= 0:
                for c in range(count):
                    row = gaussian[y, x, c]
                    if row >= 0 and seen[row] > 0:
                        amount = word[y, x] * weight[y, x, c] * seen[row] ** (power - np.float32(1))
                        _add_vote(held.label[row], held.votes[row], label[y, x], amount)
    for y in range(height):
        for x in range(width):
            for c in range(count):
                if gaussian[y, x, c] >= 0:
                    seen[gaussian[y, x, c]] = 0


@compiled
def _decide_pixels(
    gaussian: Any, weight: Any, label: Any, share: Any, class_of_object: Any, object_labels: Any, classes: Any, out: Any
) -> None:
    """The compiled loop of ``pixel_labels``, which fills ``out`` [H, W]."""
    height, width, count = weight.shape
    total = np.zeros(classes + len(object_labels), np.float32)
    by_class = np.zeros(classes, np.float32)
    for y in range(height):
        for x in range(width):
            total[:] = 0
            by_class[:] = 0
            for c in range(count):
                row = gaussian[y, x, c]
                if row < 0:
                    break
                for n in range(label.shape[1]):
                    shown, amount = label[row, n], weight[y, x, c] * share[row, n]
                    total[shown] += amount
                    by_class[shown if shown < classes else class_of_object[shown - classes]] += amount
            best = by_class.argmax()
            if by_class[best] <= 0:
                continue
            found = object_of_class(total, object_labels, class_of_object, best, LEAST_SHARE * by_class[best])
            out[y, x] = best if found < 0 else classes + found
