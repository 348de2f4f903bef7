"""3D Gaussian Splatting (3DGS): every Gaussian has its own shape, colour and labels, and no decoder makes them smooth.

It uses the tensors of the structured scene, so that everything else can be the same. An anchor is one Gaussian, its
offset is how far it has moved, in metres, and its feature holds everything else that is learnt, column by column, in
units of its learning rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional

from engine.model.anchors import UNKNOWN_CLASS, Anchors, AnchorsInView, spacing
from engine.model.checking import LARGEST_LEVEL
from engine.model.decoders import Decoders, DecoderShape, register_head
from engine.model.growing import GrowthRound, GrowthStatistics
from engine.model.neural_gaussians import NeuralGaussians
from engine.model.torch_decoding import cluster_loss

OPACITY, SCALE, QUAT, COLOUR, LABELS = slice(0, 1), slice(1, 4), slice(4, 8), slice(8, 11), 11
"""Columns of a feature: the opacity's logit, log scales, quaternion, colour as spherical harmonics of degree 0; from 11
on logits of the classes, then of the slots."""
OPACITY_RATE, SCALE_RATE, QUAT_RATE, COLOUR_RATE = 20.0, 2.0, 0.4, 1.0
"""Learning rates relative to a colour's: 3DGS's rates 0.05, 0.005, 0.001 over its 0.0025."""
LABEL_RATE = 20.0
"""3DGS has no labels. Logits start at 0 and have hundreds of steps."""
HARMONIC = 0.28209479177387814
"""The spherical harmonic of degree 0."""


@dataclass(frozen=True)
class PlainRules:
    """When Gaussians are cloned, split and pruned (3DGS, section 5.2). ``gradient`` of the projected centre in NDC
    units above which a Gaussian is cloned, or split if it is larger than ``dense_share`` of the scene's extent; below
    ``opacity`` it is removed. Opacities are reset to at most ``reset_to`` every ``reset_share`` of all steps, if these
    are at least ``reset_steps``: a shorter lift has no time to recover."""

    gradient: float = 2e-4
    dense_share: float = 0.01
    opacity: float = 0.005
    reset_share: float = 0.1
    reset_to: float = 0.01
    reset_steps: int = 500


class PlainDecoders(Decoders):
    """Replaces the decoders' networks in 3DGS: labels are columns of the features. It has nothing to train."""

    kind = "3dgs"
    decodes_all_anchors = True  # they have moved away from where they started

    def __init__(self, shape: DecoderShape, seed: int = 0) -> None:
        nn.Module.__init__(self)  # there are no networks
        self.shape = shape

    @classmethod
    def of_labels(cls, classes: int, instance_slots: int) -> PlainDecoders:
        """Return the decoders for this many classes and instance slots."""
        features = LABELS + classes + instance_slots
        return cls(DecoderShape(features, 1, classes, instance_slots, distance_input=False, label_view_input=False))

    @classmethod
    def sides(cls, shape: DecoderShape) -> dict[str, tuple[int, int]]:
        """Return the sizes of the networks: there are none, as this has no decoders."""
        return {}

    @classmethod
    def check_shape(cls, shape: DecoderShape) -> None:
        """Check the shape as ``Decoders.check_shape`` does."""
        if (shape.gaussians_per_anchor, shape.features) != (1, LABELS + shape.classes + shape.instance_slots):
            raise ValueError("the number of columns does not match the labels")

    def label_logits(self, feature: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the labels' logits, as ``Decoders.label_logits`` does, from columns of the features."""
        logits = LABEL_RATE * feature[:, None, LABELS:]
        return logits[..., : self.shape.classes], logits[..., self.shape.classes :]

    def own_decoding(self, given: AnchorsInView) -> NeuralGaussians:
        """Return the Gaussians in view, which look the same from every direction."""
        anchors, visible, _, channels, known_labels = given
        feature = anchors.feature.index_select(0, visible)
        opacity = torch.sigmoid(OPACITY_RATE * feature[:, OPACITY])
        cluster = feature.new_zeros(())
        if known_labels is not None:
            labels = known_labels.index_select(0, visible)
        else:
            logits = self.label_logits(feature, feature)
            labels = torch.cat([functional.softmax(each[:, 0], dim=1) for each in logits], dim=1)
            if channels is not None:
                cluster = cluster_loss(logits[0], channels.index_select(0, visible))
        return NeuralGaussians(
            means=anchors.position.index_select(0, visible) + anchors.offset.index_select(0, visible)[:, 0],
            scales=torch.exp(SCALE_RATE * feature[:, SCALE]),
            quats=QUAT_RATE * feature[:, QUAT],
            opacities=opacity[:, 0],
            colours=(0.5 + HARMONIC * COLOUR_RATE * feature[:, COLOUR]).clamp_min(0.0),
            labels=labels,
            visible=visible,
            all_opacities=opacity.detach(),
            kept=torch.arange(len(visible), device=visible.device),
            cluster_loss=cluster,
        )


register_head(PlainDecoders)


def plain_gaussians(
    positions: NDArray[np.float32], classes: NDArray[np.integer], rgb: NDArray[np.uint8], shape: DecoderShape
) -> Anchors:
    """Make Gaussians at ``positions`` [M, 3] metres with colours ``rgb`` uint8 [M, 3], without labels. ``classes`` [M],
    class ids of the cloud (0 unknown), are only for the cluster loss."""
    count = len(positions)
    feature = np.zeros((count, shape.features), np.float32)
    feature[:, OPACITY] = _logit(0.1) / OPACITY_RATE  # 3DGS begins with opacity 0.1
    feature[:, SCALE] = np.log(spacing(positions))[:, None] / SCALE_RATE
    feature[:, QUAT] = np.array([1.0, 0.0, 0.0, 0.0]) / QUAT_RATE
    feature[:, COLOUR] = (rgb.astype(np.float32) / 255.0 - 0.5) / HARMONIC / COLOUR_RATE
    return Anchors(
        position=torch.from_numpy(np.ascontiguousarray(positions, np.float32)),
        feature=torch.from_numpy(feature),
        offset=torch.zeros(count, 1, 3),
        log_scale=torch.zeros(count, 6),
        level=torch.zeros(count, dtype=torch.int64),
        initial_class=torch.from_numpy(np.asarray(classes, np.int64)),
    )


def clone_split_prune(
    anchors: Anchors,
    statistics: GrowthStatistics,
    rules: PlainRules,
    *,
    extent: float,
    random: np.random.Generator,
    most: int,
) -> GrowthRound:
    """Do one round of 3DGS's densification; the statistics are reset to zero in place. ``extent`` is in metres. A small
    Gaussian with a large gradient is cloned; a large one is replaced by two of 1/1.6 its size, drawn from it."""
    feature = anchors.feature.detach()
    gradient = (statistics.gradient / statistics.drawn.clamp_min(1)).squeeze(1)  # some were never drawn
    scale = torch.exp(SCALE_RATE * feature[:, SCALE])
    faint = torch.sigmoid(OPACITY_RATE * feature[:, 0]) < rules.opacity
    moved = (gradient >= rules.gradient) & ~faint
    is_large = scale.amax(dim=1) > rules.dense_share * extent
    keep = ~faint & ~(moved & is_large)
    room = max(0, most - int(keep.sum()))
    clones = anchors.select(moved & ~is_large)
    splits = _split(anchors, (moved & is_large).nonzero().squeeze(1), random)
    grown = clones.extended(splits)
    grown.level.add_(1).clamp_(max=LARGEST_LEVEL)
    grown.initial_class.fill_(UNKNOWN_CLASS)
    if len(grown) > room:
        grown = grown.select(torch.from_numpy(np.sort(random.choice(len(grown), room, replace=False))))
    for sums in statistics.tensors().values():
        sums.zero_()
    return GrowthRound(keep, grown)


def _split(anchors: Anchors, rows: torch.Tensor, random: np.random.Generator) -> Anchors:
    """Return two new Gaussians for each of ``rows`` int64 [n]."""
    halves = anchors.select(rows.repeat(2))
    scale = torch.exp(SCALE_RATE * halves.feature[:, SCALE])
    drawn = torch.from_numpy(random.standard_normal(tuple(scale.shape)).astype(np.float32)) * scale
    halves.offset += _rotated(QUAT_RATE * halves.feature[:, QUAT], drawn)[:, None]
    halves.feature[:, SCALE] -= float(np.log(1.6)) / SCALE_RATE
    return halves


def _rotated(quats: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Rotate ``vectors`` [n, 3] by ``quats`` wxyz [n, 4], which need not be normalised."""
    unit = functional.normalize(quats, dim=1)
    w, axis = unit[:, :1], unit[:, 1:]
    across = torch.linalg.cross(axis, vectors)
    return vectors + 2.0 * (w * across + torch.linalg.cross(axis, across))


def reset_opacities(anchors: Anchors, rules: PlainRules) -> None:
    """Reduce all opacities to at most ``reset_to``, in place."""
    with torch.no_grad():
        anchors.feature[:, OPACITY].clamp_(max=_logit(rules.reset_to) / OPACITY_RATE)


def _logit(share: float) -> float:
    return float(np.log(share / (1.0 - share)))
