"""What cannot be lifted is told before any work: which option an encoding of instances needs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from engine.errors import PlgsError
from engine.presets.preset import Preset
from research.baselines.options import BaselinePreset, refuse_clashing_options

PREVIEW = BaselinePreset("preview")


def test_what_a_contrastive_encoding_needs() -> None:
    refuse_clashing_options(replace(PREVIEW, instances="contrastive", objects="none"))
    with pytest.raises(PlgsError, match="needs objects=none"):
        refuse_clashing_options(replace(PREVIEW, instances="contrastive"))


def test_votes_show_no_encoding() -> None:
    assert PREVIEW.shows_votes and Preset("preview").shows_votes
    assert not replace(PREVIEW, instances="identity").shows_votes


@pytest.mark.parametrize(
    ("changed", "needed"),
    [
        ({"representation": "plain"}, "representation=structured"),
        ({"label_view_input": True}, "label_view_input=false"),
        ({"linear_assignment": True}, "linear_assignment=false"),
        ({"objects": "none"}, "objects=agreement"),
    ],
)
def test_what_an_identity_encoding_needs(changed: dict[str, object], needed: str) -> None:
    refuse_clashing_options(replace(PREVIEW, instances="identity"))
    with pytest.raises(PlgsError, match=f"needs {needed}"):
        refuse_clashing_options(replace(PREVIEW, instances="identity", **changed))  # type: ignore[arg-type]
