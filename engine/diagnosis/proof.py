"""Is a mended scene better than the one it was made from? It is read again and measured before it is handed over."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import PlgsError
from ..scene import Scene, evenly_spread, open_scene
from .findings import Diagnosis
from .reprojection import Assumption, examine
from .trials import agreement, is_far_better

_LOOKED_AT = 8
"""Frames whose depth is compared pixel by pixel."""
_KEPT = 0.9
"""Least share of the depth that a mended scene keeps."""
_NEAREST, _FARTHEST = 0.1, 50.0
"""The median depth has to lie between these metres."""
_NO_WORSE = 0.98


def harm_of(scene: Scene, diagnosis: Diagnosis, folder: Path) -> str | None:
    """Why the mended scene in ``folder`` is no improvement on ``scene``, such as "most of the depth would be lost".
    None if it is one: it opens, keeps its depth, has the size of a room, and its views agree far better.
    """
    try:
        mended = open_scene(folder)
        examined = examine(mended)
        kept, metres = _depth_left(scene, mended) if diagnosis.agreement is not None else (1.0, 1.0)
    except PlgsError as error:
        return f"it could not be read again ({error.what})"
    if diagnosis.agreement is None:
        return None
    if kept < _KEPT:
        return f"{1.0 - kept:.0%} of the depth would be lost"
    if not _NEAREST <= metres <= _FARTHEST:
        return f"the median depth would be {metres:.3g} m"
    if examined is None:
        return "fewer than three frames would have depth"
    before, after = diagnosis.agreement, agreement(examined.views, examined.pairs, Assumption())
    has_new_numbers = diagnosis.mending.assumed != Assumption() or diagnosis.mending.depth_shift != (0.0, 0.0)
    is_good = is_far_better(after, before) if has_new_numbers else after.mean >= _NO_WORSE * before.mean
    if not is_good:
        return f"its views would agree on {after.share:.0%} of what two see, against {before.share:.0%} as it is"
    return None


def _depth_left(scene: Scene, mended: Scene) -> tuple[float, float]:
    """The share of the pixels with depth that still have it, and the median depth in metres."""
    before = {frame.name: frame for frame in scene.frames}
    with_depth = [frame for frame in mended.frames if frame.read_depth is not None]
    chosen = evenly_spread(with_depth, _LOOKED_AT)
    had = sum(int((before[frame.name].depth(None) > 0.0).sum()) for frame in chosen)
    values = [depth[depth > 0.0] for depth in (frame.depth(None) for frame in chosen)]
    has = sum(len(each) for each in values)
    return has / max(had, 1), float(np.median(np.concatenate(values))) if has else 0.0
