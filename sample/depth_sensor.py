"""What a structured-light sensor makes of exact depth: coarse, noisy, quantised, torn at edges, and full of holes.

Depth is planar z in metres, float64 [H, W], 0 = none. Such a sensor measures disparity: focal length times baseline
over depth. So errors grow with the square of depth (Khoshelham and Elberink 2012). The constants of the Kinect are
those of Nguyen, Izadi and Lovell 2012.
"""

from __future__ import annotations

from statistics import NormalDist

import cv2
import numpy as np
from capture_noise import CaptureNoise, Floats, Pixels
from numpy.typing import NDArray

Bools = NDArray[np.bool_]
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


def half_size(depth: Floats, noise: CaptureNoise) -> Floats:
    """Depth at half the size, as the sensor has fewer pixels than the camera.

    Pixels of one surface are averaged in 1 / z, in which planes are linear. In a block with two surfaces, the nearest
    one counts. Holes do not count.
    """
    height, width = depth.shape
    even = np.pad(depth, ((0, height % 2), (0, width % 2)), mode="edge")
    blocks = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).swapaxes(1, 2).reshape(-1, 4)
    inverse = _inverse(blocks)
    nearest = inverse.max(-1)
    same = (blocks > 0.0) & (inverse > nearest[:, None] * (1.0 - noise.edge))
    mean = (inverse * same).sum(-1) / np.maximum(same.sum(-1), 1)
    return _inverse(mean).reshape(even.shape[0] // 2, -1)


def flying_pixels(depth: Floats, noise: CaptureNoise, random: np.random.Generator) -> Floats:
    """Depth with values between the two sides of an edge, where a pixel receives light from both surfaces."""
    square = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(np.where(depth > 0.0, depth, np.inf), square)
    farthest = cv2.dilate(depth, square)
    mixes = at_edges(depth, noise) & (random.random(depth.shape) < noise.flying)
    share = random.random(depth.shape)
    return np.where(mixes, share * np.where(mixes, nearest, 0.0) + (1.0 - share) * farthest, depth)


def at_edges(depth: Floats, noise: CaptureNoise) -> Bools:
    """Where depth jumps, bool [H, W]. 1 / z is linear on any plane, so slanted surfaces have no edges."""
    inverse = _inverse(depth)
    jumps = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        before, after = _gradients(inverse, axis)
        jumps |= np.abs(after - before) > noise.edge * inverse
    known = cv2.erode((depth > 0.0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return jumps & known


def deviation(depth: Floats, noise: CaptureNoise) -> Floats:
    """The standard deviation of measured depth in metres, float64 [H, W]. It grows with the square of depth."""
    return noise.depth_floor + noise.depth_growth * (depth - noise.depth_nearest) ** 2


def noisy(depth: Floats, noise: CaptureNoise, random: np.random.Generator) -> Floats:
    """Depth with axial noise. Neighbours' noise is correlated, as the sensor matches windows of its pattern."""
    field = smooth_field(depth.shape, noise.depth_grain, random)
    return np.where(depth > 0.0, np.maximum(depth + deviation(depth, noise) * field, 0.01), 0.0)


def quantised(depth: Floats, noise: CaptureNoise) -> Floats:
    """Depth at whole steps of the sensor's disparity: 3 mm apart at 1 m, 46 mm at 4 m."""
    scale = noise.focal_baseline / noise.disparity_step
    steps = np.maximum(np.round(scale / np.maximum(depth, 1e-6)), 1.0)
    return np.where(depth > 0.0, scale / steps, 0.0)


def holes(chance: Floats, noise: CaptureNoise, random: np.random.Generator) -> Bools:
    """Where nothing comes back, bool [H, W], for a chance float64 [H, W]. Holes are blobs, not single pixels."""
    field = smooth_field(chance.shape, noise.hole_grain, random)
    uniform = 1.0 / (1.0 + np.exp(-1.702 * field))  # the logistic curve is within 0.01 of the normal distribution's
    return uniform < chance


def chance_of_holes(
    depth: Floats, light: Pixels, rays: Floats, points: Floats, noise: CaptureNoise, waves: Floats
) -> Floats:
    """The chance of a hole, float64 [H, W], from independent causes.

    ``light`` float32 [H, W, 3] is linear colour at full exposure, ``rays`` float64 [H, W, 3] are lines of sight with
    z = 1, ``points`` the surface in the world, and ``waves`` those of ``polish_waves``.
    """
    causes = (
        darkness(light, noise),
        highlights(light, noise),
        polish(points, waves, noise),
        slant(depth, rays, noise),
        distance(depth, noise),
    )
    returns = np.ones_like(depth)
    for cause in causes:
        returns *= 1.0 - noise.lost * cause
    return 1.0 - returns


def darkness(light: Pixels, noise: CaptureNoise) -> Floats:
    """0..1, 1 where a surface swallows light. The sensor's own lamp lights it, so exposure does not matter."""
    nothing, everything = noise.dark
    return _ramp((light @ LUMINANCE).astype(np.float64), everything, nothing)


def highlights(light: Pixels, noise: CaptureNoise) -> Floats:
    """0 or 1, 1 at lamps and their mirror images: bright, colourless, and brighter than what surrounds them."""
    level, above = noise.highlight
    luminance = light @ LUMINANCE
    around = cv2.GaussianBlur(luminance, (0, 0), 0.05 * light.shape[1])
    colourless = light.max(-1) - light.min(-1) < 0.3 * light.max(-1)
    return ((luminance > level) & (luminance - around > above) & colourless).astype(np.float64)


def polish_waves(noise: CaptureNoise, random: np.random.Generator) -> Floats:
    """Waves that make places of the world polished, float64 [16, 4]: directions in 1 / metres, and phases."""
    count = 16
    directions = random.normal(size=(count, 3)) / noise.polished_size
    return np.concatenate([directions, random.random((count, 1)) * 2.0 * np.pi], -1)


def polish(points: Floats, waves: Floats, noise: CaptureNoise) -> Floats:
    """0 or 1, 1 on smooth patches that mirror the sensor's light away. They are the same in all frames."""
    value = np.cos(points @ waves[:, :3].T + waves[:, 3]).sum(-1) * np.sqrt(2.0 / len(waves))
    return (value > NormalDist().inv_cdf(1.0 - noise.polished)).astype(np.float64)


def slant(depth: Floats, rays: Floats, noise: CaptureNoise) -> Floats:
    """0..1, 1 where the line of sight grazes the surface, so that the pattern is stretched and dim.

    The normal is that of the plane a x + b y + c = 1 / z through the pixel. The smaller of the gradients to both sides
    counts, so that an edge is not a slant.
    """
    inverse = _inverse(depth)
    step_x, step_y = rays[0, 1, 0] - rays[0, 0, 0], rays[1, 0, 1] - rays[0, 0, 1]
    a, b = _lesser_gradient(inverse, 1) / step_x, _lesser_gradient(inverse, 0) / step_y
    # The plane's c follows from the pixel itself; the ray times the normal is then 1 / z.
    c = inverse - a * rays[..., 0] - b * rays[..., 1]
    cosine = inverse / np.maximum(np.sqrt(a**2 + b**2 + c**2) * np.linalg.norm(rays, axis=-1), 1e-9)
    nothing, everything = noise.grazing
    return np.where(depth > 0.0, _ramp(cosine, everything, nothing), 0.0)


def distance(depth: Floats, noise: CaptureNoise) -> Floats:
    """0..1, 1 beyond the sensor's reach. The pattern's light falls with the square of depth."""
    return _ramp(depth, *noise.reach)


def smooth_field(shape: tuple[int, ...], grain: float, random: np.random.Generator) -> Floats:
    """Normal noise of mean 0 and deviation 1, float64 [H, W], correlated over ``grain`` pixels of an image 320 wide."""
    sigma = max(grain * shape[1] / 320.0, 0.5)
    margin = int(np.ceil(3.0 * sigma))
    white = random.normal(size=(shape[0] + 2 * margin, shape[1] + 2 * margin))
    kernel = cv2.getGaussianKernel(2 * margin + 1, sigma)
    smooth = cv2.sepFilter2D(white, -1, kernel, kernel)[margin:-margin, margin:-margin]
    return smooth / float((kernel**2).sum())


def _ramp(values: Floats, zero: float, one: float) -> Floats:
    """0 at ``zero``, 1 at ``one``, linear in between. Either one may be larger."""
    return ((values - zero) / (one - zero)).clip(0.0, 1.0)


def _lesser_gradient(values: Floats, axis: int) -> Floats:
    """The difference to the neighbour before or after along ``axis``, whichever is smaller."""
    before, after = _gradients(values, axis)
    return np.where(np.abs(after) < np.abs(before), after, before)


def _gradients(values: Floats, axis: int) -> tuple[Floats, Floats]:
    """The differences to the neighbours before and after along ``axis``. At the rim both are the same."""
    steps = np.diff(values, axis=axis)
    return np.concatenate([steps.take([0], axis), steps], axis), np.concatenate([steps, steps.take([-1], axis)], axis)


def _inverse(depth: Floats) -> Floats:
    """1 / z, and 0 where there is no depth."""
    return np.where(depth > 0.0, 1.0 / np.maximum(depth, 1e-6), 0.0)
