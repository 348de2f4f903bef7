"""One picture of all lifts: a row each, cut out of their own contact sheets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..job import write_atomically
from ..passes.contact_sheet import first_row
from ..passes.previews import png_bytes

SHEET = Path("result/previews/contact_sheet.png")


def write_sheet(path: Path, lifts: Mapping[str, Path]) -> None:
    """The first held-out frame of each lift (caption to folder): photo, machine mask, lifted classes and instances.
    Nothing where no lift has a contact sheet. Raises OSError."""
    strips = [first_row(lift / SHEET, caption) for caption, lift in lifts.items() if (lift / SHEET).is_file()]
    if strips:
        width = max(strip.shape[1] for strip in strips)
        wide = [np.pad(strip, ((0, 0), (0, width - strip.shape[1]), (0, 0))) for strip in strips]
        write_atomically(path, png_bytes(np.concatenate(wide)))
