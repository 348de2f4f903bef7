"""The options of baselines and of ablations that no preset of the engine has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from engine.presets.preset import PRESETS, Preset


@dataclass(frozen=True)
class BaselinePreset(Preset):
    """A preset with further options for baselines and ablations; their defaults change nothing."""

    representation: Literal["structured", "plain"] = "structured"
    """With "plain" it is 3DGS with labels on each Gaussian (``gaussian_splatting``)."""
    semantic_targets: Literal["projected", "masks", "none"] = "projected"
    """Classes are learnt from the projected cloud or the votes, from the input masks, or by L_cluster alone."""
    labelled_start: bool = True
    """If false, anchors and decoders start with only the cloud's colours."""
    segment_consistency: bool = False
    """All pixels of a segment should have the same class, whichever it is (Panoptic Lifting; ``segment_targets``)."""


def with_baseline_options() -> None:
    """Add these options to the presets of this process, so that they can be set by name and read from requests."""
    PRESETS.update({name: BaselinePreset(**vars(preset)) for name, preset in PRESETS.items()})
