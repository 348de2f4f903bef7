"""Names of frames from the paths of their pictures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

_NOT_IN_NAMES = re.compile(r'[\x00-\x1f<>:"|?*]')


def frame_names(paths: Sequence[str]) -> list[str]:
    """The stems of ``paths`` where these are all different, else the whole paths with ``_`` between their parts.

    Other files are named after frames, so what no file name can hold becomes ``_`` too.
    """
    parts = [PurePosixPath(path.replace("\\", "/")).with_suffix("").parts for path in paths]
    stems = [each[-1] if each else "" for each in parts]
    if len(set(stems)) < len(stems):
        stems = ["_".join(part for part in each if part not in (".", "..", "/")) for each in parts]
    return [_NOT_IN_NAMES.sub("_", stem) or "_" for stem in stems]
