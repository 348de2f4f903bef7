"""How the pixels of a picture are dealt out to threads: in bands that depend on their number alone, so that sums over
bands have the same bits however many threads there are."""

from __future__ import annotations

from typing import Any

from ..machine.compiled import compiled

BAND = 8192
"""Pixels of one band."""


def band_count(pixels: int) -> int:
    return -(-pixels // BAND)


@compiled
def band_of(band: int, pixels: int) -> Any:
    """First pixel of a band, and the one behind its last."""
    return band * BAND, min((band + 1) * BAND, pixels)
