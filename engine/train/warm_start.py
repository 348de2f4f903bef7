"""Fits the decoders to the initial anchors before any picture is rendered.

The semantic point cloud already tells the colour, class and instance of each anchor. Fitting decoders to these takes
seconds, as nothing is rendered; learning them from pictures takes thousands of steps. This is ours, not the paper's:
the preset "paper" starts from random decoders."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn import functional

from ..machine.threads import two_torch_threads
from ..model.anchors import UNKNOWN_CLASS
from ..model.structured import StructuredScene
from ..scene import Progress, watched
from .optimiser import adam_step, no_moments
from .targets import columns_of, slots_of

STEPS = 400
BATCH = 4096
"""The number of anchors in a step."""
RATE = 0.01
"""The learning rate of the first step; it falls to zero."""
OPACITY_BIAS = 0.3
"""Added before the tanh, so that fewer Gaussians start invisible (and without a gradient)."""
FITTED = ("colour", "semantic", "instance")


@two_torch_threads()
def warm_start(
    scene: StructuredScene,
    colour: np.ndarray,
    instance_id: np.ndarray | None,
    viewpoints: np.ndarray,
    *,
    seed: int,
    progress: Progress = lambda *_: None,
) -> None:
    """Fit the colour, semantic and instance decoders, in place, to the initial anchors, and raise opacities a little.
    The anchors have colours ``colour`` uint8 [M, 3] and instances ``instance_id`` int32 [M] (0 = none; None: no objects
    are known). ``viewpoints`` float64 [N, 3]: camera centres, metres, from which colours are seen. Deterministic by
    ``seed``."""
    anchors, decoders = scene.anchors, scene.decoders
    random = np.random.default_rng([seed, 3])
    initial = anchors.initial_class.numpy()
    classes = columns_of(initial, scene.channels.class_ids)
    slots = torch.full_like(classes, -1)
    if instance_id is not None:
        slots = slots_of(instance_id, initial != UNKNOWN_CLASS, scene.channels).long()
    target_colour = torch.from_numpy(colour.astype(np.float32) / 255.0)
    centres = torch.from_numpy(viewpoints.astype(np.float32))
    k = anchors.gaussians_per_anchor
    with torch.no_grad():
        decoders.opacity.get_parameter("2.bias").add_(OPACITY_BIAS)  # of the last linear layer
    parameters = [each for name, group in decoders.learnt() if name in FITTED for each in group]
    moments = [no_moments(each) for each in parameters]
    for step in watched(range(STEPS), progress):
        rows = torch.from_numpy(random.integers(0, len(anchors), min(BATCH, len(anchors))))
        centre = centres[torch.from_numpy(random.integers(0, len(centres), len(rows)))]
        feature = anchors.feature.detach()[rows]
        seen = decoders.view_input(feature, anchors.position[rows], centre)
        shown = torch.sigmoid(decoders.colour(seen)).view(len(rows), k, 3)
        loss = (shown - target_colour[rows][:, None]).abs().mean()
        for logits, target in zip(decoders.label_logits(feature, seen), (classes[rows], slots[rows]), strict=True):
            if bool((target >= 0).any()):  # cross_entropy without any target is NaN
                flat = logits.reshape(len(rows) * k, -1)
                loss = loss + functional.cross_entropy(flat, target.repeat_interleave(k), ignore_index=-1)
        loss.backward()
        adam_step(parameters, moments, step, RATE * (1 - step / STEPS), eps=1e-8, fused=False)
