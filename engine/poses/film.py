"""The sharpest pictures of a film, evenly spread over its length, as image files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..errors import PlgsError
from ..scene.formats.photos import Video
from ..scene.frame_choice import CANDIDATES, photo_detail

_QUALITY = 95


def write_pictures(film: Path, folder: Path, most: int, progress: Callable[[int, int], object]) -> None:
    """Write at most ``most`` pictures of a film as ``folder/NNNNNN.jpg``, named by their number in the film.

    ``progress`` is called with the numbers of pictures done and of all. Raises PlgsError, OSError.
    """
    import cv2

    video = Video(film)
    count = video.count()
    edges = np.linspace(0, count, min(most, count) + 1).astype(int)
    folder.mkdir(parents=True)
    for done, (first, after) in enumerate(zip(edges[:-1], edges[1:], strict=True), start=1):
        numbers = np.unique(np.linspace(first, after - 1, CANDIDATES).round().astype(int))
        pictures = {int(number): video.frame(int(number)) for number in numbers}
        sharpest = max(pictures, key=lambda number: photo_detail(pictures[number]))
        options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        good, data = cv2.imencode(".jpg", np.ascontiguousarray(pictures[sharpest][..., ::-1]), options)
        if not good:
            raise PlgsError(f"picture {sharpest} of the film cannot be written", film, "Extract its pictures yourself.")
        (folder / f"{sharpest:06d}.jpg").write_bytes(data.tobytes())
        progress(done, len(edges) - 1)
