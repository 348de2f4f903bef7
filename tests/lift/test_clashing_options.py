"""What cannot be lifted is told before any work: which option an encoding of instances needs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from engine.job import JobError
from engine.lift.clashing_options import refuse_clashing_options
from engine.train.presets import PRESETS

PREVIEW = PRESETS["preview"]


def test_what_a_contrastive_encoding_needs() -> None:
    refuse_clashing_options(replace(PREVIEW, instances="contrastive", objects="none"))
    with pytest.raises(JobError, match="needs objects=none"):
        refuse_clashing_options(replace(PREVIEW, instances="contrastive"))


@pytest.mark.parametrize("name", PRESETS)
def test_presets_do_not_clash(name: str) -> None:
    refuse_clashing_options(PRESETS[name])


@pytest.mark.parametrize(
    ("changed", "needed"),
    [
        ({"representation": "plain"}, "representation=structured"),
        ({"label_view_input": True}, "label_view_input=false"),
        ({"linear_assignment": True}, "linear_assignment=false"),
        ({"objects": "none"}, "objects=agreement"),
        ({"matched_masks": False}, "matched_masks=true"),
    ],
)
def test_what_an_identity_encoding_needs(changed: dict[str, object], needed: str) -> None:
    refuse_clashing_options(replace(PREVIEW, instances="identity"))
    with pytest.raises(JobError, match=f"needs {needed}"):
        refuse_clashing_options(replace(PREVIEW, instances="identity", **changed))  # type: ignore[arg-type]
