"""Options that say nothing together are refused before any work."""

from __future__ import annotations

from collections.abc import Iterator

from ..job import JobError
from ..train.presets import Preset


def refuse_clashing_options(preset: Preset) -> None:
    """Raise JobError for what tells instances apart by an encoding, but cannot."""
    for needed in _needed(preset):
        raise JobError(f'instances = "{preset.instances}" needs {needed}', "the options", f"Add --set {needed}.")


def _needed(preset: Preset) -> Iterator[str]:
    """What an encoding needs and does not have."""
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
    if preset.instances == "identity" and not preset.matched_masks:
        yield "matched_masks=true"
