"""The constants and the camera that all back ends share."""

from __future__ import annotations

from dataclasses import dataclass

NEAR = 0.01
"""Metres. Nothing at or before this depth is drawn."""
BLUR = 0.3
"""Pixels squared, added to both diagonal entries of a 2D covariance: nothing is thinner than a pixel."""
ALPHA_MAX = 0.99
"""The largest alpha of a Gaussian, so that a single one never closes a pixel."""
ALPHA_MIN = 1.0 / 255.0
"""A Gaussian with a smaller alpha than this is skipped."""
TRANSMITTANCE_END = 1e-4
"""A Gaussian that would leave this transmittance or less is not blended, and the pixel ends."""
CLAMP_MARGIN = 0.3
"""The Jacobian of the projection is taken outside the image by at most this share of the half field of view."""
TINY_NORM = 1e-12
"""Quaternions shorter than this are divided by it instead of by their norm."""


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A pinhole camera.

    ``rotation`` 3 by 3, row by row, world to camera (OpenCV axes); ``centre`` metres, world; ``focal`` and
    ``principal`` (x, y) in pixels; ``width``, ``height`` in pixels; ``near`` in metres. If only some rows of a
    picture are drawn, ``height`` counts them, ``above`` those before them and ``whole_height`` all of the picture.
    """

    rotation: tuple[float, ...]
    centre: tuple[float, float, float]
    focal: tuple[float, float]
    principal: tuple[float, float]
    width: int
    height: int
    near: float
    above: int = 0
    whole_height: int | None = None

    def slope_limits(self) -> tuple[float, float, float, float]:
        """(x low, x high, y low, y high): the slopes x/z and y/z to which the Jacobian's point is clamped.

        These are the limits of the whole picture, so that a Gaussian has the same footprint in all rows.
        """
        (fx, fy), (cx, cy) = self.focal, self.principal
        cy, height = cy + self.above, self.whole_height or self.height
        margin_x = CLAMP_MARGIN * 0.5 * self.width / fx
        margin_y = CLAMP_MARGIN * 0.5 * height / fy
        return (
            -cx / fx - margin_x,
            (self.width - cx) / fx + margin_x,
            -cy / fy - margin_y,
            (height - cy) / fy + margin_y,
        )
