"""The options of baselines and of ablations that no preset of the engine has."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from engine.errors import PlgsError
from engine.presets.preset import PRESETS, Preset


@dataclass(frozen=True)
class BaselinePreset(Preset):
    """A preset with these options in addition to the engine's; their defaults leave it as it is."""

    representation: Literal["structured", "plain"] = "structured"
    """With "plain" it is 3DGS with labels on each Gaussian (``gaussian_splatting``)."""
    semantic_targets: Literal["projected", "masks", "none"] = "projected"
    """Classes are learnt from the projected cloud, or the votes; from the input masks; or by L_cluster alone."""
    labelled_start: bool = True
    """Without it anchors and decoders start with only the cloud's colours."""
    vote_from: Literal["objects", "masks"] = "objects"
    """The labels that are voted onto Gaussians come from the voted objects, or straight from the masks."""
    instances: Literal["slots", "identity", "contrastive"] = "slots"
    """What tells instances apart: probabilities of slots; an encoding that the matched masks teach (Gaussian
    Grouping's); or one that needs no matching, whose clusters are the instances (Contrastive Lift's). The finished
    scene then shows these, not the votes."""
    segment_consistency: bool = False
    """All pixels of a segment should have the same class, whichever it is (Panoptic Lifting; see ``segment_loss``)."""

    @property
    def can_vote(self) -> bool:
        return super().can_vote and self.instances == "slots"


def with_baseline_options() -> None:
    """Let the presets of this process have these options, so that they can be given by name and read from requests."""
    PRESETS.update({name: BaselinePreset(**vars(preset)) for name, preset in PRESETS.items()})


def refuse_clashing_options(preset: BaselinePreset) -> None:
    """Raise PlgsError, before any work, for an encoding of instances without the options that it needs."""
    for needed in _needed(preset):
        what = f'instances = "{preset.instances}" needs {needed}'
        raise PlgsError(what, "the options", f"Add --set {needed}.", option="--set")


def _needed(preset: BaselinePreset) -> Iterator[str]:
    """What an encoding needs but does not have."""
    if preset.instances == "slots":
        return
    if preset.representation != "structured":
        yield "representation=structured"
    if preset.label_view_input:
        yield "label_view_input=false"
    if preset.linear_assignment:
        yield "linear_assignment=false"
    if preset.instances == "contrastive" and preset.objects != "none":
        yield "objects=none"
    if preset.instances == "identity" and preset.objects == "none":
        yield "objects=agreement"
