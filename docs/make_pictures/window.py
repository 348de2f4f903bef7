"""Blender's window: what a window test took, cut and tiled. See tests/window/test_pictures.py for its command."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from .sheets import Picture, tiled

ROOT = Path(__file__).resolve().parents[2]
SCREENSHOTS, PICTURES = ROOT / "build" / "window" / "screenshots", ROOT / "docs" / "pictures"
VIEW, ROOM = np.s_[126:900, 50:770], np.s_[126:790, 50:770]
"""The 3D view's part of the screen, without its header and its text, its tools and the sidebar; and without the lower
part, which has a legend or nothing."""
QUALITY = 82


def taken(name: str) -> Picture:
    """A screenshot. SystemExit if it was not taken."""
    picture = cv2.imread(str(SCREENSHOTS / f"docs-{name}.png"))
    if picture is None:
        raise SystemExit(f"there is no screenshot docs-{name}: run tests/window/test_pictures.py first")
    return np.asarray(picture[..., ::-1], np.uint8)


def sheets() -> dict[str, Picture]:
    """The pictures by their names in docs/pictures."""
    looks = {name: taken(f"look-{name.lower()}")[VIEW] for name in ("Photo", "Classes", "Instances", "Uncertainty")}
    kinds = {
        "Points, Material Preview": taken("points-material")[ROOM],
        "Splats, Material Preview": taken("splats-material")[ROOM],
        "Splats, Rendered (EEVEE)": taken("splats-rendered")[ROOM],
        "Surface, Material Preview": taken("surface-material")[ROOM],
    }
    return {
        "window_overview": taken("opened"),
        "window_looks": tiled(looks, 2, 480),
        "window_shown_as": tiled(kinds, 2, 480),
        "window_beside": taken("beside"),
        "window_best_view": taken("best-view")[ROOM],
        "window_lifting": taken("lifting"),
        "window_compositor": taken("compositor"),
        "window_import": tiled({"imported": taken("imported"), "masks": taken("masks")}, 2, 640),
    }


def main() -> int:
    """Write them all; the exit code."""
    for name, picture in sheets().items():
        path = PICTURES / f"{name}.jpg"
        if not cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY]):
            raise OSError(f"{path} cannot be written")
        print(f"{path}: {picture.shape[1]}x{picture.shape[0]}, {path.stat().st_size // 1000} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
