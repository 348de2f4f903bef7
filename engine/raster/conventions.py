"""The camera, the constants and the layout of arrays that the back ends share."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..machine.compiled import device_function

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
"""A point farther outside the image than this share of half the field of view is moved to that limit, where the
Jacobian is taken."""
NEAR_MEDIAN = 0.05
"""Contributors whose depth differs from a pixel's median by at most this share of it belong to the surface there."""
USUAL_DISTANCE = 2.0
"""Metres: used as an orthographic camera's distance by rules that need one, since it has none; usual for photos of a
room."""
TINY_NORM = 1e-12
"""Quaternions shorter than this are divided by it instead of by their norm."""


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A camera. ``rotation``: 3 x 3, row by row, world to camera (OpenCV axes); ``centre``: world, metres; ``focal``,
    ``principal`` (x, y), ``width``, ``height``: pixels; ``near``: metres. To draw only some rows of a picture,
    ``height`` is their number, ``above`` the number of rows before them, and ``whole_height`` the height of the
    picture. With ``is_orthographic`` all rays are parallel, and ``focal`` is in pixels per metre."""

    rotation: tuple[float, ...]
    centre: tuple[float, float, float]
    focal: tuple[float, float]
    principal: tuple[float, float]
    width: int
    height: int
    near: float
    above: int = 0
    whole_height: int | None = None
    is_orthographic: bool = False

    @property
    def surface_reach(self) -> tuple[float, float]:
        """How far around a pixel's median depth its surface extends: a share of that depth, plus metres."""
        return (0.0, NEAR_MEDIAN * USUAL_DISTANCE) if self.is_orthographic else (NEAR_MEDIAN, 0.0)

    def slope_limits(self) -> tuple[float, float, float, float]:
        """(x low, x high, y low, y high): the range to which the slopes x/z and y/z are clamped before the Jacobian is
        taken, the same in the whole picture, so that a Gaussian has one footprint in all rows. 0 for parallel rays."""
        if self.is_orthographic:
            return 0.0, 0.0, 0.0, 0.0
        (fx, fy), (cx, cy) = self.focal, self.principal
        cy, height = cy + self.above, self.whole_height or self.height
        x, y = CLAMP_MARGIN * 0.5 * self.width / fx, CLAMP_MARGIN * 0.5 * height / fy
        return -cx / fx - x, (self.width - cx) / fx + x, -cy / fy - y, (height - cy) / fy + y


# What the kernels know about a projected Gaussian: one cache line of float32, and the form of its footprint.
#
# A footprint is kept whitened. With the inverse 2D covariance written as L^T L, L upper triangular, and d the
# offset of a pixel from the centre, s = sqrt(log2(e) / 2) * L d has |s|^2 = log2(e) * d^T inv(cov) d / 2, so
# alpha = opacity * 2^-|s|^2. Compared with the usual quadratic form nothing cancels, however long and thin the
# Gaussian: s1 and s2 are computed to float32 precision from a double origin at each tile, s2 is constant along
# a row of pixels, and s1 is linear in it.

TILE = 16
"""The number of pixels along a tile's side, and in a vector."""
PATCH_WIDTH, PATCH_HEIGHT = TILE // 2, 2
"""The number of pixels along a patch's sides. A patch fills one vector: eight columns of two rows."""
assert (PATCH_WIDTH, PATCH_HEIGHT) == (8, 2), "the vector kernels alternate the rows of a patch, in pairs of lanes"
BATCH = 64
"""How many Gaussians of a tile are blended together: they fill whole vectors, and have a bit each in a bit mask."""
assert BATCH % TILE == 0 and BATCH <= 64
PENDING = 2 * BATCH
"""A patch that lists more blended Gaussians than this adds up their labels before the next batch."""
BACKWARD_BATCH = 96
"""Gaussians of a tile whose label gradients are added up together."""
MEMBERS = TILE * (BACKWARD_BATCH + 4)
"""Slots for the Gaussians listed on each patch of a tile, and for placeholders that fill up the last four."""
assert 2 * (PENDING + BATCH + 4) <= MEMBERS, "the two patches of a strip list more of them"

# columns of a record; the centre is the sum of two floats (a double's precision where it matters)
CENTRE_X, CENTRE_X_LOW, CENTRE_Y, CENTRE_Y_LOW = 0, 1, 2, 3
L11, L12, L22 = 4, 5, 6
OPACITY = 7
LOG_OPACITY = 8  # to base two
RED, GREEN, BLUE, DEPTH = 9, 10, 11, 12
L11_LOW, L12_LOW, L22_LOW = 13, 14, 15  # what float32 rounded off; it matters far from the centre of a long Gaussian
RECORD = 16

# columns of the gradients of one Gaussian in one tile; g = dLoss/d(ln alpha) summed over pixels
G, G_S1, G_S1S1, G_S2, G_S1S2, G_S2S2 = 0, 1, 2, 3, 4, 5
D_RED, D_GREEN, D_BLUE, D_DEPTH = 6, 7, 8, 9
GRADIENT = 10
GRADIENT_WIDTH = 16
"""Floats per gradient slot."""

WHITENING = math.sqrt(0.5 * math.log2(math.e))
"""The factor between L d and the whitened offset s (see above)."""
REACH_OVER_LOG_OPACITY = np.float32(math.log2(255.0) + 1e-3)
"""Added to ``LOG_OPACITY``: the |s|^2 beyond which alpha < 1/255, rounded up by far more than the rounding of s and far
less than a pixel."""


@device_function
def padded_channels(channels: int) -> int:
    """Return the number of channels rounded up to a multiple of TILE, so that they fill whole vectors."""
    return (channels + TILE - 1) // TILE * TILE
