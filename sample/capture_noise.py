"""Degrade exact colour, poses and depth as a hand-held camera with a structured-light sensor would.

All functions are pure: the same values and the same random stream give the same result. Colour is linear light, float32
[H, W, 3] with 1 = white. ``linear`` and ``srgb`` convert it. Depth is planar z in metres, float64 [H, W], 0 = none.
Such a sensor measures disparity: focal length times baseline over depth. So errors grow with the square of depth
(Khoshelham and Elberink 2012). The constants of the Kinect are those of Nguyen, Izadi and Lovell 2012."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Pixels = NDArray[np.float32]
Bools = NDArray[np.bool_]
Size = tuple[int, int]
"""(width, height) in pixels."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


@dataclass(frozen=True)
class CaptureNoise:
    """How much a capture differs from a rendering: numbers, explained below each. ``*_frames``: correlation lengths."""

    gain: float = 2.0
    """Largest factor by which exposure and white balance together brighten or darken linear light."""
    exposure_frames: float = 10.0
    white_balance: float = 0.12
    """Largest relative change of a channel beside the exposure."""
    white_balance_frames: float = 20.0
    blurred: float = 0.1
    """Share of the frames with motion blur."""
    blur_length: tuple[float, float] = (5.0, 11.0)
    """Pixels of a picture 640 wide."""
    border: tuple[float, float] = (0.01, 0.025)
    """Narrowest and widest black border, as shares of the width."""
    pose_shift: float = 0.005
    """Root mean square over the frames, metres."""
    pose_turn: float = 0.3
    """Root mean square over the frames, degrees."""
    pose_frames: float = 15.0
    depth_floor: float = 0.0012
    """Metres, the standard deviation of depth at ``depth_nearest``."""
    depth_growth: float = 0.0019
    """Growth of the standard deviation with the square of the metres beyond ``depth_nearest``."""
    depth_nearest: float = 0.4
    depth_grain: float = 1.5
    """Pixels of a depth image 320 wide over which its noise is correlated (the blur's standard deviation)."""
    focal_baseline: float = 43.5
    """Pixels times metres. The first Kinect has a focal length of 580 and a baseline of 7.5 cm."""
    disparity_step: float = 0.125
    """Pixels, the sensor's resolution."""
    dark: tuple[float, float] = (0.006, 0.03)
    """Linear luminance up to which almost nothing, and from which everything comes back."""
    highlight: tuple[float, float] = (0.5, 0.15)
    """Linear luminance of a highlight, and how far it is above what surrounds it."""
    polished: float = 0.02
    """Share of the surfaces that mirror the sensor's light away."""
    polished_size: float = 0.3
    """Metres, about the size of such a patch."""
    grazing: tuple[float, float] = (0.1, 0.25)
    """Cosine between line of sight and normal up to which nothing, and from which everything comes back."""
    reach: tuple[float, float] = (6.0, 8.0)
    """Metres up to which everything, and from which nearly nothing comes back."""
    lost: float = 0.97
    """Chance of a hole where one of the causes above is at its worst."""
    hole_grain: float = 3.0
    """Pixels of a depth image 320 wide over which a hole's outline is correlated."""
    edge: float = 0.04
    """Relative step of 1 / depth that counts as an edge."""
    flying: float = 0.4
    """Share of the pixels at an edge that mix both sides."""


def drift(count: int, channels: int, length: float, random: np.random.Generator) -> Floats:
    """Return smooth random functions of the frame number, float64 [count, channels], roughly normal with deviation 1.
    They are random Fourier features of a Gaussian kernel: hands, auto exposure and trackers err slowly."""
    waves = 16
    frequencies = random.normal(size=(channels, waves)) / length
    phases = random.random((channels, waves)) * 2.0 * np.pi
    return np.cos(np.arange(count)[:, None, None] * frequencies + phases).sum(-1) * np.sqrt(2.0 / waves)


def colour_gains(count: int, noise: CaptureNoise, random: np.random.Generator) -> Floats:
    """Return the factors of each frame's linear light, float64 [count, 3] (red, green, blue), from 1 / gain to gain.
    Auto exposure changes all channels together, automatic white balance each one. Both are logarithmic, so one stop up
    is as likely as one stop down."""
    tint = np.log1p(noise.white_balance)
    exposures = np.tanh(drift(count, 1, noise.exposure_frames, random)) * (np.log(noise.gain) - tint)
    tints = np.tanh(drift(count, 3, noise.white_balance_frames, random)) * tint
    return np.exp(exposures + tints)


def blurred_frames(count: int, noise: CaptureNoise, random: np.random.Generator) -> dict[int, Floats]:
    """Return the motion of the blurred frames, float64 [2] (right, down) in fractions of the width, by frame number.
    The hand moves along a line while the shutter is open, in any direction, by ``blur_length``."""
    chosen = sorted(random.choice(count, round(noise.blurred * count), replace=False).tolist())
    lengths = random.uniform(*noise.blur_length, len(chosen)) / 640.0
    angles = random.uniform(0.0, np.pi, len(chosen))
    motions = lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], -1)
    return dict(zip(chosen, motions, strict=True))


def motion_blur(light: Pixels, motion: Floats) -> Pixels:
    """Return the mean of linear light [H, W, 3] over a straight motion, float64 [2] pixels, centred on the pixel."""
    reach = int(np.ceil(np.abs(motion).max() / 2.0)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for share in np.linspace(-0.5, 0.5, 64):
        x, y = motion * share + reach
        left, top = int(x), int(y)
        across, down = x - left, y - top
        kernel[top : top + 2, left : left + 2] += np.outer([1.0 - down, down], [1.0 - across, across])
    return cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)  # type: ignore[return-value]


def border_mask(size: Size, noise: CaptureNoise, random: np.random.Generator) -> Bools:
    """Return the pixels that undistortion leaves black, bool [H, W]. Undistortion moves the picture's edges inwards by
    a parabola. The parabola differs on each side, as lenses are not quite centred. Interpolation adds a slight wave."""
    width, height = size
    narrow, wide = noise.border[0] * width, noise.border[1] * width
    insets = []
    for along in (height, height, width, width):
        along_edge = (np.arange(along) + 0.5) / along * 2.0 - 1.0
        start, bend, centre, wave, phase = random.random(5)
        curve = 0.3 * start + 0.6 * (0.5 + bend) * (along_edge - 0.4 * (centre - 0.5)) ** 2
        curve += 0.1 * np.sin(2.0 * np.pi * ((2.0 + 3.0 * wave) * along_edge + phase))
        insets.append(narrow + (wide - narrow) * curve.clip(0.0, 1.0))
    left, right, top, bottom = insets
    x, y = np.arange(width) + 0.5, (np.arange(height) + 0.5)[:, None]
    return (x < left[:, None]) | (width - x < right[:, None]) | (y < top) | (height - y < bottom)


def pose_errors(count: int, noise: CaptureNoise, random: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the tracker's errors: shifts float64 [count, 3] in metres, rotations float64 [count, 3] (axis times
    radians). They change slowly, as trackers drift and correct themselves. ``noise`` has their sizes (RMS)."""
    shifts = drift(count, 3, noise.pose_frames, random)
    turns = drift(count, 3, noise.pose_frames, random)
    return _with_rms(shifts, noise.pose_shift), _with_rms(turns, float(np.radians(noise.pose_turn)))


def _with_rms(values: Floats, target: float) -> Floats:
    """Return vectors [count, 3] without their mean, which would move the world, scaled to the RMS ``target``."""
    centred = values - values.mean(0)
    return centred * (target / max(float(np.sqrt((centred**2).sum(-1).mean())), 1e-9))


def misplaced(pose: Floats, shift: Floats, turn: Floats) -> Floats:
    """Return a camera-to-world pose, float64 [4, 4], shifted in the world and rotated about the camera's own centre."""
    wrong = pose.copy()
    wrong[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(turn)[0]
    wrong[:3, 3] += shift
    return wrong


def linear(colour: NDArray[np.uint8]) -> Pixels:
    """Convert 8-bit sRGB [H, W, 3] to linear light (IEC 61966-2-1)."""
    value = np.arange(256) / 255.0
    table = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[colour]


def srgb(light: Pixels) -> NDArray[np.uint8]:
    """Convert linear light [H, W, 3] to 8-bit sRGB; light brighter than white is clipped, as by a sensor."""
    value = light.clip(0.0, 1.0)
    curve = np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-9) ** (1.0 / 2.4) - 0.055)
    return (curve * 255.0 + 0.5).astype(np.uint8)


def half_size(depth: Floats, noise: CaptureNoise) -> Floats:
    """Return depth at half the size, as the sensor has fewer pixels than the camera. Pixels of one surface are averaged
    in 1 / z, in which planes are linear. In a block with two surfaces, the nearest one counts. Holes do not count."""
    height, width = depth.shape
    even = np.pad(depth, ((0, height % 2), (0, width % 2)), mode="edge")
    blocks = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).swapaxes(1, 2).reshape(-1, 4)
    inverse = _inverse(blocks)
    nearest = inverse.max(-1)
    same = (blocks > 0.0) & (inverse > nearest[:, None] * (1.0 - noise.edge))
    mean = (inverse * same).sum(-1) / np.maximum(same.sum(-1), 1)
    return _inverse(mean).reshape(even.shape[0] // 2, -1)


def flying_pixels(depth: Floats, noise: CaptureNoise, random: np.random.Generator) -> Floats:
    """Return depth with values between the two sides of an edge, where a pixel receives light from both surfaces."""
    square = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(np.where(depth > 0.0, depth, np.inf), square)
    farthest = cv2.dilate(depth, square)
    mixes = at_edges(depth, noise) & (random.random(depth.shape) < noise.flying)
    share = random.random(depth.shape)
    return np.where(mixes, share * np.where(mixes, nearest, 0.0) + (1.0 - share) * farthest, depth)


def at_edges(depth: Floats, noise: CaptureNoise) -> Bools:
    """Return where depth jumps, bool [H, W]. 1 / z is linear on any plane, so slanted surfaces have no edges."""
    inverse = _inverse(depth)
    jumps = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        before, after = _gradients(inverse, axis)
        jumps |= np.abs(after - before) > noise.edge * inverse
    known = cv2.erode((depth > 0.0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return jumps & known


def deviation(depth: Floats, noise: CaptureNoise) -> Floats:
    """Return the standard deviation of measured depth in metres, float64 [H, W]. It grows with the square of depth."""
    return noise.depth_floor + noise.depth_growth * (depth - noise.depth_nearest) ** 2


def noisy(depth: Floats, noise: CaptureNoise, random: np.random.Generator) -> Floats:
    """Return depth with axial noise. Neighbours' noise is correlated, as the sensor matches windows of its pattern."""
    field = smooth_field(depth.shape, noise.depth_grain, random)
    return np.where(depth > 0.0, np.maximum(depth + deviation(depth, noise) * field, 0.01), 0.0)


def quantised(depth: Floats, noise: CaptureNoise) -> Floats:
    """Return depth at whole steps of the sensor's disparity: 3 mm apart at 1 m, 46 mm at 4 m."""
    scale = noise.focal_baseline / noise.disparity_step
    steps = np.maximum(np.round(scale / np.maximum(depth, 1e-6)), 1.0)
    return np.where(depth > 0.0, scale / steps, 0.0)


def holes(chance: Floats, noise: CaptureNoise, random: np.random.Generator) -> Bools:
    """Return where no depth is measured, bool [H, W], for a chance float64 [H, W]; holes are blobs, not pixels."""
    field = smooth_field(chance.shape, noise.hole_grain, random)
    uniform = 1.0 / (1.0 + np.exp(-1.702 * field))  # the logistic curve is within 0.01 of the normal distribution's
    return uniform < chance


def chance_of_holes(
    depth: Floats, light: Pixels, rays: Floats, *, points: Floats, noise: CaptureNoise, waves: Floats
) -> Floats:
    """Return the chance of a hole, float64 [H, W], from independent causes. ``light`` float32 [H, W, 3] is linear
    colour at full exposure, ``rays`` float64 [H, W, 3] are lines of sight with z = 1, ``points`` the surface in the
    world, and ``waves`` those of ``polish_waves``."""
    causes = (
        # A surface swallows light. The sensor's own lamp lights it, so exposure does not matter.
        _ramp((light @ LUMINANCE).astype(np.float64), *reversed(noise.dark)),
        highlights(light, noise),
        polish(points, waves, noise),
        slant(depth, rays, noise),
        _ramp(depth, *noise.reach),  # the pattern's light falls with the square of depth
    )
    returns = np.ones_like(depth)
    for cause in causes:
        returns *= 1.0 - noise.lost * cause
    return 1.0 - returns


def highlights(light: Pixels, noise: CaptureNoise) -> Floats:
    """Return 1 at lamps and mirror images of them (bright, colourless, brighter than around), else 0; [H, W]."""
    level, above = noise.highlight
    luminance = light @ LUMINANCE
    around = cv2.GaussianBlur(luminance, (0, 0), 0.05 * light.shape[1])
    colourless = light.max(-1) - light.min(-1) < 0.3 * light.max(-1)
    return ((luminance > level) & (luminance - around > above) & colourless).astype(np.float64)


def polish_waves(noise: CaptureNoise, random: np.random.Generator) -> Floats:
    """Return waves by which places are polished, float64 [16, 4]: directions in 1 / metres, and phases."""
    count = 16
    directions = random.normal(size=(count, 3)) / noise.polished_size
    return np.concatenate([directions, random.random((count, 1)) * 2.0 * np.pi], -1)


def polish(points: Floats, waves: Floats, noise: CaptureNoise) -> Floats:
    """Return 1 on smooth patches that mirror the sensor's light away, the same in all frames, else 0; [H, W]."""
    value = np.cos(points @ waves[:, :3].T + waves[:, 3]).sum(-1) * np.sqrt(2.0 / len(waves))
    return (value > NormalDist().inv_cdf(1.0 - noise.polished)).astype(np.float64)


def slant(depth: Floats, rays: Floats, noise: CaptureNoise) -> Floats:
    """Return how much the line of sight grazes the surface, 0..1, [H, W]: at 1, the pattern is stretched and dim. The
    normal is that of the plane a x + b y + c = 1 / z through the pixel. The smaller of the gradients to both sides
    counts, so that an edge is not a slant."""
    inverse = _inverse(depth)
    step_x, step_y = rays[0, 1, 0] - rays[0, 0, 0], rays[1, 0, 1] - rays[0, 0, 1]
    a, b = _lesser_gradient(inverse, 1) / step_x, _lesser_gradient(inverse, 0) / step_y
    # The plane's c follows from the pixel itself; the ray times the normal is then 1 / z.
    c = inverse - a * rays[..., 0] - b * rays[..., 1]
    cosine = inverse / np.maximum(np.sqrt(a**2 + b**2 + c**2) * np.linalg.norm(rays, axis=-1), 1e-9)
    nothing, everything = noise.grazing
    return np.where(depth > 0.0, _ramp(cosine, everything, nothing), 0.0)


def smooth_field(shape: tuple[int, ...], grain: float, random: np.random.Generator) -> Floats:
    """Return normal noise, mean 0 and deviation 1, float64 [H, W], correlated over ``grain`` pixels of 320 across."""
    sigma = max(grain * shape[1] / 320.0, 0.5)
    margin = int(np.ceil(3.0 * sigma))
    white = random.normal(size=(shape[0] + 2 * margin, shape[1] + 2 * margin))
    kernel = cv2.getGaussianKernel(2 * margin + 1, sigma)
    smooth = cv2.sepFilter2D(white, -1, kernel, kernel)[margin:-margin, margin:-margin]
    return smooth / float((kernel**2).sum())


def _ramp(values: Floats, zero: float, one: float) -> Floats:
    """Map ``zero`` to 0 and ``one`` to 1, linear in between and clamped beyond. Either one may be larger."""
    return ((values - zero) / (one - zero)).clip(0.0, 1.0)


def _lesser_gradient(values: Floats, axis: int) -> Floats:
    """Return the difference to the neighbour before or after along ``axis``, whichever is smaller."""
    before, after = _gradients(values, axis)
    return np.where(np.abs(after) < np.abs(before), after, before)


def _gradients(values: Floats, axis: int) -> tuple[Floats, Floats]:
    """The differences to the neighbours before and after along ``axis``. At the edge of the array both are the same."""
    steps = np.diff(values, axis=axis)
    return np.concatenate([steps.take([0], axis), steps], axis), np.concatenate([steps, steps.take([-1], axis)], axis)


def _inverse(depth: Floats) -> Floats:
    """Return 1 / z, and 0 where there is no depth."""
    return np.where(depth > 0.0, 1.0 / np.maximum(depth, 1e-6), 0.0)
