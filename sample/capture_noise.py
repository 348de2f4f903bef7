"""What a hand-held camera does to colour and poses: gain, tint, motion blur, black borders, drift.

``depth_sensor.py`` does the same for depth. All functions are pure: the same values and the same random stream give the
same result. Colour is linear light, float32 [H, W, 3] with 1 = white. ``linear`` and ``srgb`` convert it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Pixels = NDArray[np.float32]
Size = tuple[int, int]
"""(width, height) in pixels."""


@dataclass(frozen=True)
class CaptureNoise:
    """How much a capture differs from a rendering. ``*_frames`` are correlation lengths in frames."""

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
    """Smooth random functions of the frame number, float64 [count, channels], roughly normal with deviation 1.

    They are random Fourier features of a Gaussian kernel. Hands, auto exposure and trackers err slowly.
    """
    waves = 16
    frequencies = random.normal(size=(channels, waves)) / length
    phases = random.random((channels, waves)) * 2.0 * np.pi
    return np.cos(np.arange(count)[:, None, None] * frequencies + phases).sum(-1) * np.sqrt(2.0 / waves)


def colour_gains(count: int, noise: CaptureNoise, random: np.random.Generator) -> Floats:
    """The factors of each frame's linear light, float64 [count, 3] (red, green, blue), from 1 / gain to gain.

    Auto exposure changes all channels together, automatic white balance each one. Both are logarithmic, so one stop up
    is as likely as one stop down.
    """
    tint = np.log1p(noise.white_balance)
    exposures = np.tanh(drift(count, 1, noise.exposure_frames, random)) * (np.log(noise.gain) - tint)
    tints = np.tanh(drift(count, 3, noise.white_balance_frames, random)) * tint
    return np.exp(exposures + tints)


def blurred_frames(count: int, noise: CaptureNoise, random: np.random.Generator) -> dict[int, Floats]:
    """The motion of the blurred frames, float64 [2] (right, down) in shares of the width, by frame number.

    The hand moves along a line while the shutter is open, in any direction, by ``blur_length``.
    """
    chosen = sorted(random.choice(count, round(noise.blurred * count), replace=False).tolist())
    lengths = random.uniform(*noise.blur_length, len(chosen)) / 640.0
    angles = random.uniform(0.0, np.pi, len(chosen))
    motions = lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], -1)
    return dict(zip(chosen, motions, strict=True))


def motion_blur(light: Pixels, motion: Floats) -> Pixels:
    """The mean of linear light [H, W, 3] over a straight motion, float64 [2] pixels, centred on the pixel."""
    reach = int(np.ceil(np.abs(motion).max() / 2.0)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for share in np.linspace(-0.5, 0.5, 64):
        x, y = motion * share + reach
        left, top = int(x), int(y)
        across, down = x - left, y - top
        kernel[top : top + 2, left : left + 2] += np.outer([1.0 - down, down], [1.0 - across, across])
    return cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)  # type: ignore[return-value]


def border_mask(size: Size, noise: CaptureNoise, random: np.random.Generator) -> NDArray[np.bool_]:
    """The pixels that undistortion leaves black, bool [H, W].

    Undistortion moves the picture's edges inwards by a parabola. It differs on each side, as lenses are not quite
    centred. Interpolation adds a slight wave.
    """
    width, height = size
    narrow, wide = noise.border[0] * width, noise.border[1] * width
    insets = []
    for along in (height, height, width, width):
        place = (np.arange(along) + 0.5) / along * 2.0 - 1.0
        start, bend, centre, wave, phase = random.random(5)
        curve = 0.3 * start + 0.6 * (0.5 + bend) * (place - 0.4 * (centre - 0.5)) ** 2
        curve += 0.1 * np.sin(2.0 * np.pi * ((2.0 + 3.0 * wave) * place + phase))
        insets.append(narrow + (wide - narrow) * curve.clip(0.0, 1.0))
    left, right, top, bottom = insets
    x, y = np.arange(width) + 0.5, (np.arange(height) + 0.5)[:, None]
    return (x < left[:, None]) | (width - x < right[:, None]) | (y < top) | (height - y < bottom)


def pose_errors(count: int, noise: CaptureNoise, random: np.random.Generator) -> tuple[Floats, Floats]:
    """The tracker's errors: shifts float64 [count, 3] in metres, turns float64 [count, 3] (axis times radians).

    They change slowly along the path, as trackers drift and correct themselves. ``noise`` has their root mean squares.
    """
    shifts = drift(count, 3, noise.pose_frames, random)
    turns = drift(count, 3, noise.pose_frames, random)
    return _with_rms(shifts, noise.pose_shift), _with_rms(turns, float(np.radians(noise.pose_turn)))


def _with_rms(values: Floats, target: float) -> Floats:
    """Vectors [count, 3] without their mean, scaled to a root mean square length. A mean would move the world."""
    centred = values - values.mean(0)
    return centred * (target / max(float(np.sqrt((centred**2).sum(-1).mean())), 1e-9))


def misplaced(pose: Floats, shift: Floats, turn: Floats) -> Floats:
    """A camera-to-world pose, float64 [4, 4], shifted in the world and turned about the camera's own centre."""
    wrong = pose.copy()
    wrong[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(turn)[0]
    wrong[:3, 3] += shift
    return wrong


def linear(colour: NDArray[np.uint8]) -> Pixels:
    """Linear light of 8-bit sRGB (IEC 61966-2-1)."""
    value = np.arange(256) / 255.0
    table = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[colour]


def srgb(light: Pixels) -> NDArray[np.uint8]:
    """8-bit sRGB of linear light. Light brighter than white is clipped, as by a sensor's full wells."""
    value = light.clip(0.0, 1.0)
    curve = np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-9) ** (1.0 / 2.4) - 0.055)
    return (curve * 255.0 + 0.5).astype(np.uint8)
