"""The small room that comes with the extension, for users who have no capture of their own."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..engine.errors import PlgsError
from ..engine.job.process import ROOT

SAMPLE = ROOT / "sample" / "room"
_ONLY_FOR_RESEARCH = shutil.ignore_patterns("gt", "panoptic_second*")


def own_sample() -> Path:
    """Return a copy of the room in the user's home, as lifts lie beside their scene; it is made if missing. Raises
    PlgsError if the extension lacks it; OSError."""
    folder = Path.home() / "PLGS Sample" / SAMPLE.name
    if folder.is_dir():
        return folder
    if not SAMPLE.is_dir():
        raise PlgsError("no-sample", "the sample room is missing from this PLGS", SAMPLE, "Install its zip again.")
    part = folder.with_name(f"{SAMPLE.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(SAMPLE, part, ignore=_ONLY_FOR_RESEARCH)
    part.replace(folder)
    return folder
